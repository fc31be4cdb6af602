"""Parts of errors, angles and pairs of visits, from which the measurement model is estimated, of made passes."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline import shipped as shipped_files
from pbl_pipeline.gait import MEASURES, change_sd, measurement
from research.corpus.found_variance import found_variance
from research.corpus.measurement import (
    Seen,
    angle_errors,
    change_pairs,
    coverage_by_chance,
    lasting_table,
    parts_of_errors,
    probability_errors,
    widening_of,
    write_model,
)
from research.corpus.passes import save_rows

STANCE = MEASURES.index("stance_percent")
SPEED = MEASURES.index("speed_m_per_s")


def made(walk: int, view: str, visit: int, errors: np.ndarray, angles: np.ndarray | None = None) -> Seen:
    nothing, true = np.zeros((2, 2)), np.full(len(MEASURES), 50.0)
    off = np.zeros((2, 2, 3, 2)) if angles is None else angles
    about = f"p{walk}", False, "synthetic", "", 0.0, view, visit, ("left", 0)
    return Seen(*about, (), (), nothing, np.eye(2), np.stack([true + errors, true]), off)


def test_parts_of_errors_are_found_again():
    """Bias 2, lasting 1, visit 0.5, anew 0.8 of 3,000 walks; the speed is known at the first visit alone, with a bias
    of -3 and 1 in each pass."""
    rng = np.random.default_rng(0)
    seen = []
    for walk in range(3000):
        lasting = 2.0 + rng.normal()
        for visit in (0, 1):
            of_visit = lasting + 0.5 * rng.normal()
            for _ in range(2):
                errors = np.full(len(MEASURES), np.nan)
                errors[STANCE] = of_visit + 0.8 * rng.normal()
                errors[SPEED] = np.nan if visit else -3.0 + rng.normal()
                seen.append(made(walk, "sagittal", visit, errors))
    found = parts_of_errors(seen)
    assert found["stance_percent"] == pytest.approx((np.sqrt(5.0), 0.5, 0.8), abs=0.06)
    assert found["speed_m_per_s"] == pytest.approx((3.0, 0.0, 1.0), abs=0.25)
    assert set(found) == {"stance_percent", "speed_m_per_s"}


def test_the_near_leg_is_told_from_the_far_one():
    """Filmed from the left ("sagittal") the left leg is near; from the right, the right one."""
    none, seen = np.zeros(len(MEASURES)), []
    for view, near in (("sagittal", 0), ("sagittal_right", 1), ("rear", 0)):
        angles = np.zeros((2, 2, 3, 2))
        angles[0, near, 2, 1] = 5.0  # range of the knee
        seen.append(made(0, view, 0, none, angles))
    table: Any = angle_errors(seen).set_index(["from", "angle", "of"])["bias"]
    assert table["sides, near leg", "knee_flexion", "range"] == 5.0
    assert table["sides, far leg", "knee_flexion", "range"] == 0.0
    assert table["front, back", "knee_flexion", "range"] == 2.5


def test_pairs_of_visits_and_what_is_said_of_them():
    about = {"person": "a", "severity": 0.0, "sd": 5.0, "sd_anew": 3.0}
    healthy, crouch = ((0, "", 90.0, 91.0), (1, "", 91.0, 91.0)), ((0, "crouch", 70.0, 71.0), (1, "crouch", 72.0, 71.0))
    rows = [
        {"kind": kind, **about, "visit": visit, "condition": condition, "found": found, "true": true}
        for kind in ("left", "front")
        for visit, condition, found, true in (*healthy, *crouch)
    ]
    pairs = change_pairs(pd.DataFrame(rows))
    assert len(pairs) == 3 * 4  # each kind, and from the left and then from the front
    alike = pairs[pairs["kind"] == "left"]
    least = 1.6449 * np.sqrt(2) * 3.0
    np.testing.assert_allclose(alike["sd"], change_sd((least, least), (5.0, 5.0)))
    np.testing.assert_allclose(pairs.loc[pairs["kind"] == "left, then front", "sd"], np.hypot(5, 5))
    assert sorted(alike["found"]) == [-18.0, 1.0, 2.0, 21.0]
    table = probability_errors(pairs).set_index("session")
    assert table.loc["left", ["unchanged", "called real", "changed", "in 90 %"]].tolist() == [2, 0.0, 2, 1.0]
    assert table.loc["left", "Brier, real"] < 0.01


def test_widening_and_chance_of_persons():
    ratio = np.concatenate([np.linspace(0, 1.0, 50), np.linspace(0, 3.0, 50)])
    frame = pd.DataFrame({"person": ["a"] * 50 + ["b"] * 50, "ratio": ratio})
    widening = widening_of(frame)
    assert (ratio <= widening * 1.6449).mean() == pytest.approx(0.9, abs=0.02)
    by_person, drawn = coverage_by_chance(frame, widening, 2)
    assert by_person.tolist() == pytest.approx([0.8, 1.0], abs=0.03)
    assert drawn[0] == pytest.approx(by_person[0])
    assert drawn[2] == pytest.approx(by_person[1])


def test_the_lasting_parts_of_the_indexs_error_are_found_again():
    """Bias 1, person 3, walk 2, anew 1.5 of 2,000 persons of three walks; one more person has a single walk."""
    rng, rows = np.random.default_rng(4), []
    for person in range(2000):
        lasting = 1.0 + rng.normal(0, 3.0)
        for condition in ("", "crouch", "weakness") if person else ("",):
            of_walk = lasting + rng.normal(0, 2.0)
            about = {"kind": "left", "person": f"p{person}", "condition": condition, "severity": 0.0, "true": 90.0}
            rows += [{**about, "visit": v, "found": 90.0 + of_walk + rng.normal(0, 1.5)} for v in (0, 1) for _ in "ab"]
    table = lasting_table(pd.DataFrame(rows)).set_index("session")
    assert table.loc["left"].tolist() == pytest.approx([np.sqrt(10.0), 2.0, 1.5], abs=0.15)


def test_a_written_model_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shipped = measurement.load_model("blazepose-33")
    write_model(shipped, tmp_path / "toy.json", "by this test")
    monkeypatch.setattr(shipped_files, "shipped_text", lambda path: (tmp_path / Path(path).name).read_text())
    found = measurement.load_model("toy")
    assert (found.name, found.fits, found.widening) == (shipped.name, shipped.fits, shipped.widening)
    assert found.measures == shipped.measures
    for side in ("", "left", "right"):
        np.testing.assert_array_equal(found.views[side].gain, shipped.views[side].gain)
        np.testing.assert_array_equal(found.views[side].anew, shipped.views[side].anew)
    np.testing.assert_array_equal(found.person, shipped.person)
    measurement.load_model.cache_clear()


def test_a_file_cut_in_the_middle_of_writing_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    meanwhile: list[Path] = []

    def cut(path: Path, **_: Any) -> None:
        path.write_bytes(b"PK")
        meanwhile.extend(tmp_path.glob("passes-*.npz"))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", cut)
        with pytest.raises(KeyboardInterrupt):
            save_rows(tmp_path / "passes-0.npz", [{"n": 1}])
    assert meanwhile == list(tmp_path.iterdir()) == []
    save_rows(tmp_path / "passes-0.npz", [{"n": 1}])
    assert [p.name for p in tmp_path.iterdir()] == ["passes-0.npz"]


def test_what_the_errors_of_one_pass_add_to_the_scores():
    """Least-squares scores of one pass have the inverse of the gain; the covariance of error and score is that of ridge
    regression."""
    model = measurement.load_model("blazepose-heat-maps")
    view = model.views["left"]
    inverse = np.linalg.inv(view.gain)
    stated, longer = found_variance(model, ("left",))
    error = model.person + model.visit + view.view + view.anew
    assert stated == pytest.approx(np.trace(inverse @ error @ inverse.T))
    assert longer - stated == pytest.approx(2.0 * measurement.RIDGE * np.trace(np.eye(len(inverse)) - inverse))
