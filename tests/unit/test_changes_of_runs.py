"""Whether a measure changed since an earlier run: `pbl run --compare` and `pbl gait --compare`."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from pbl_pipeline import pipeline
from pbl_pipeline.change import Change, earlier_visit, visit_changes
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import gait_metrics
from pbl_pipeline.visit import Recording, Visit, load_visit, save_visit
from tests import not_none
from tests.command import pbl
from tests.unit.visits import solution_of
from tests.walking_fit import walking_fit


@pytest.fixture(scope="module")
def visit() -> Visit:
    fit = walking_fit(name="walk", n_frames=300)
    visit = Visit((Recording.of("walk", fit),), solution_of(fit), methods={"Fit": "f-v1"}, subject="P1")
    return visit.with_measures(gait_metrics([fit]))


@pytest.fixture(scope="module")
def folders(visit: Visit, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    now, before = (tmp_path_factory.mktemp(name) for name in ("now", "before"))
    save_visit(visit, now)
    save_visit(dataclasses.replace(visit, label="June"), before)
    return now, before


def with_index(visit: Visit, **changes: float) -> Visit:
    measures = not_none(visit.measures)
    index = dataclasses.replace(measures.gdi, **changes)
    return dataclasses.replace(visit, measures=dataclasses.replace(measures, gdi=index))


def test_a_change_is_judged_as_on_the_pages(visit):
    before = with_index(visit, mean=80.0, sd=4.0, minimal_change=5.0)
    now = with_index(visit, mean=86.0, sd=4.0, minimal_change=5.5)
    rows = {row["measure"]: row for row in visit_changes(now, before)}
    assert rows["gdi"]["change"] == 6.0
    assert (rows["gdi"]["least"], rows["gdi"]["verdict"]) == (5.5, "more than chance")
    assert rows["gdi"]["real"] == pytest.approx(0.884, abs=0.001)
    assert (rows["cadence_steps_per_min"]["change"], rows["cadence_steps_per_min"]["real"]) == (0.0, None)
    less = {row["measure"]: row for row in visit_changes(with_index(now, mean=84.0), before)}
    assert less["gdi"]["verdict"] == "may be chance"
    other = dataclasses.replace(visit.recordings[0].fit, height_m=1.7)
    filmed = dataclasses.replace(now, recordings=(Recording.of("walk", other).with_measured(visit.measures.trials[0]),))
    row = visit_changes(filmed, before)[0]
    assert (row["verdict"], row["least"]) == ("cannot be judged", None)
    assert row["not_comparable"] == "height (stated, before: not_stated)"
    other = dataclasses.replace(visit.recordings[0].fit, with_depths=True)
    filmed = dataclasses.replace(now, recordings=(Recording.of("walk", other).with_measured(visit.measures.trials[0]),))
    assert visit_changes(filmed, before)[0]["not_comparable"] == "height (depths, before: not_stated)"


def test_gait_compares_with_a_folder_and_writes_it(folders):
    now, before = folders
    out = now / "metrics.json"
    assert pbl("gait", now / "walk.fit.npz", "--out", out).code == 0
    plain = json.loads(out.read_text())
    done = pbl("gait", now / "walk.fit.npz", "--out", out, "--compare", before / "session.json")
    assert done.code == 0, done.err
    assert "changes since P1 June" in done.out
    written = json.loads(out.read_text())
    rows = written.pop("changes")["measures"]
    assert written == plain
    assert {"gdi", "cadence_steps_per_min"} <= {row["measure"] for row in rows}
    assert all(row["verdict"] in done.out for row in rows)
    assert load_visit(now).measures is not None  # the file is still one of a visit


def test_run_compares(folders, visit, tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "run_visit", lambda *_: (visit, {}))
    done = pbl("run", "walk.mp4", "--out", tmp_path / "out", "--compare", folders[1])
    assert done.code == 0, done.err
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["changes"]["since"] == "P1 June"


def test_what_is_no_earlier_visit_is_refused(folders, visit, tmp_path):
    now, before = folders

    def refused(path: Path, *person: Any, out: Path = now) -> tuple[str, str]:
        with pytest.raises(PblError) as raised:
            earlier_visit(path, out, *person)
        return raised.value.code, raised.value.found

    assert refused(tmp_path / "none")[0] == "FILE_MISSING"
    assert refused(before / "metrics.json")[0] == "FILE_FORMAT"
    assert refused(before / "none" / "session.json")[0] == "FILE_MISSING"
    assert refused(now)[0] == "USAGE"
    assert refused(before, "P2") == ("USAGE", "visits of P1 and of P2")
    small = Recording.of("walk", dataclasses.replace(visit.recordings[0].fit, height_m=1.2))
    child = dataclasses.replace(visit, recordings=(small.with_measured(visit.measures.trials[0]),), subject="-")
    save_visit(child, tmp_path / "child")
    assert refused(tmp_path / "child", "P1", 1.8) == ("USAGE", "a person of 1.20 m, now one of 1.80 m")
    assert earlier_visit(tmp_path / "child", now, "P1", 1.25).height_m == 1.2  # grown
    save_visit(visit, unmeasured := tmp_path / "unmeasured")
    (unmeasured / "metrics.json").unlink()
    assert "metrics.json" in refused(unmeasured)[1]
    other = dataclasses.replace(visit, methods={"Fit": "f-v2"})
    with pytest.raises(PblError, match=r"other methods: f-v1 \(earlier\), f-v2"):
        visit_changes(other, visit)


def test_a_change_of_nothing_has_no_sign():
    assert str(Change(-1e-5, False, 2.0).row("speed_m_per_s")["change"]) == "0.0"
