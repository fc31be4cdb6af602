"""The tables as most tests of this folder want them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import schemas
from tests.rows import remove_all

from . import chain


@pytest.fixture(scope="module")
def declared(database: Path) -> None:
    """All tables with their method rows."""
    schemas.activate()


@pytest.fixture
def tables(declared: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Empty tables with the method rows, and stand-ins for the slow stages."""
    chain.install(monkeypatch)
    yield
    remove_all()


@pytest.fixture
def drop(tables: None, tmp_path: Path) -> Path:
    """An empty drop folder."""
    folder = tmp_path / "uploads"
    folder.mkdir()
    return folder


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A Chromium of the machine, without windows. Skips where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="pip install -e .[browser]")
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()
