"""The tables as most tests of this folder want them."""

import functools
import threading
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

import pbl_schemas
from pbl_schemas.datajoint_setup import datajoint
from tests import Environment
from tests.rows import Saved, remove_all

from . import chain


@pytest.fixture(scope="session", autouse=True)
def tables_have_one_thread() -> Iterator[None]:
    """Refuse a question that a page asks of the tables where it works on files, beside the thread of the tables: their
    connection would answer one with the rows of the other."""
    query = datajoint.Connection.query

    def asked(self: Any, *args: Any, **options: Any) -> Any:
        assert not threading.current_thread().name.startswith("asyncio_"), f"beside the thread of the tables: {args}"
        return query(self, *args, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datajoint.Connection, "query", asked)
        yield


@pytest.fixture(scope="module")
def declared(database: Path) -> None:
    """All tables with their method rows."""
    pbl_schemas.activate()


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins for the slow stages (`chain`)."""
    chain.install(monkeypatch)


@pytest.fixture
def change_fits(stand_ins: None, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Lets the library fit what a function makes of the fits of the stand-in (`chain.change_fits`)."""
    return functools.partial(chain.change_fits, monkeypatch)


@pytest.fixture
def tables(declared: None, stand_ins: None) -> Iterator[None]:
    """Empty tables with the method rows, and stand-ins for the slow stages."""
    yield
    remove_all()


@pytest.fixture(scope="module")
def fill(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Callable[[Path], Any]], Any]:
    """A call that fills empty tables as `build(folder)` does, once in a module: after that it puts the rows back."""
    made: dict[Callable[[Path], Any], tuple[Any, Saved]] = {}

    def filled(build: Callable[[Path], Any]) -> Any:
        if build in made:
            made[build][1].put_back()
        else:
            folder = tmp_path_factory.mktemp("videos")
            made[build] = build(folder), Saved(folder, tmp_path_factory.mktemp("saved"))
        return made[build][0]

    return filled


@pytest.fixture(scope="module")
def module_patch() -> Iterator[pytest.MonkeyPatch]:
    """What a module of tests replaces, put back at its end."""
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def module_tables(
    declared: None, module_patch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Path]:
    """`tables` of a whole module, which fills them once; yields a folder for its videos."""
    chain.install(module_patch)
    yield tmp_path_factory.mktemp("videos")
    remove_all()


@pytest.fixture
def drop(tables: None, tmp_path: Path, environment: Environment) -> Path:
    """An empty drop folder, which PBL_INCOMING names."""
    folder = tmp_path / "uploads"
    folder.mkdir()
    environment(PBL_INCOMING=folder)
    return folder


@pytest.fixture
def archive(tmp_path: Path, environment: Environment) -> Path:
    """The folder of the archive, which PBL_ARCHIVE names; whoever writes first makes it."""
    environment(PBL_ARCHIVE=tmp_path / "archive")
    return tmp_path / "archive"


@pytest.fixture(scope="session")
def axe() -> str:
    """axe-core as a script."""
    return (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")
