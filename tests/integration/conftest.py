"""The tables as most tests of this folder want them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

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
