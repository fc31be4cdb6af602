"""The notebooks of the docs run in their order, on one database, and show what they have stored."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import pbl_schemas
from pbl_schemas import connection
from pbl_schemas.connection import dj, schema_name
from pbl_schemas.operations import catalog
from tests import notebook
from tests.command import pbl
from tests.rows import remove_all

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("points_seen_once")]

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "notebooks"
_NUMBER, _TAG = r"-?\d+(?:\.\d+)?", r"<style.*?</style>|<[^>]*>"
#: Those that measure the demo recording: processors round differently, so printed numbers may be off by so much.
MEASURED, WITHIN = ("02_populate", "03_query", "05_own_table"), 0.1


@pytest.fixture
def own_tables(database: Path) -> Iterator[None]:
    """Empty tables, and none of the notebooks' own afterwards."""
    pbl_schemas.activate()
    remove_all()
    yield
    dj.Schema(schema_name("mylab")).drop(prompt=False)
    remove_all()


def test_the_notebooks_run_in_order_and_show_what_they_say(
    own_tables: None, demo_files: dict[str, Path], tmp_path: Path
):
    """To store what they show now: `python -m tests.notebook docs/notebooks/*.ipynb`."""
    paths = sorted(FOLDER.glob("*.ipynb"))
    assert [p.name[:2] for p in paths] == ["01", "02", "03", "04", "05"]
    for path in paths:
        shown, now = json.loads(path.read_text(encoding="utf-8")), notebook.run(path, tmp_path)
        assert len(shown["cells"]) == len(now["cells"])
        assert any(cell.get("outputs") for cell in shown["cells"]), "nothing is stored"
        for number, (old, new) in enumerate(zip(shown["cells"], now["cells"], strict=True)):
            where = f"{path.name}, cell {number}"
            assert [_kind(o) for o in _outputs(new)] == [_kind(o) for o in _outputs(old)], where
            for a, b in zip(_outputs(new), _outputs(old), strict=True):
                _compare(a, b, WITHIN if path.stem in MEASURED else 0.0, where)
    # What 05 says of its table, which no command of ours knows: a person is removed from it too.
    assert _rows_of_notebook_5() == 1
    assert pbl("forget", "P001", "--yes").code == 0
    assert _rows_of_notebook_5() == 0


def _rows_of_notebook_5() -> int:
    table = catalog.quote(schema_name("mylab"), "__cycle_spread")
    return int(connection.connect().query(f"SELECT count(*) FROM {table}").fetchone()[0])


def _outputs(cell: dict[str, Any]) -> list[dict[str, Any]]:
    return cell.get("outputs", [])


def _kind(output: dict[str, Any]) -> tuple[str, ...]:
    return (output["output_type"], *sorted(output.get("data", ())))


def _compare(now: dict[str, Any], shown: dict[str, Any], within: float, where: str) -> None:
    """The same words in prints and frames, and the same numbers in prints, as far as they are measured alike."""
    if now["output_type"] == "stream":
        a, b = "".join(now["text"]), "".join(shown["text"])
        found, stored = (list(map(float, re.findall(_NUMBER, text))) for text in (a, b))
        assert _words(a) == _words(b), where
        assert found == pytest.approx(stored, rel=within, abs=within), where
    elif "text/html" in now["data"]:
        a, b = (re.sub(_TAG, " ", "".join(o["data"]["text/html"]), flags=re.DOTALL) for o in (now, shown))
        assert _words(a) == _words(b), where


def _words(text: str) -> list[str]:
    return re.sub(_NUMBER, "#", text).split()
