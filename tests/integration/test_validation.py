"""References and errors in the tables, from `pbl validate add` to the printed tables."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pbl_schemas
from pbl_pipeline.body import load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.synthetic import SynthSpec, synthesise
from pbl_pipeline.validation import Reference, compare, reference_of_fit
from pbl_schemas import lab, validation, video
from pbl_schemas.chain import is_wanted
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.intake.references import add_reference, find_video, read_reference
from pbl_schemas.reading import frames
from pbl_schemas.reading.status import pipeline_status
from pbl_workers.populate import populate
from tests import SHARED
from tests.command import pbl
from tests.rows import everything_but_refreshes, register
from tests.walking_fit import walking_fit

from . import chain

#: What the reference differs from the fit by: two frames later, the right knee bent 5 degrees more.
LAG_S, KNEE_DEG = 2 / 30, 5.0


def fitted(n_frames: int = chain.N_FRAMES) -> TrialFit:
    """What the stand-in of the fit makes of a video."""
    body = load_body()
    return walking_fit(body.joint_names, body.sha256, n_frames=n_frames)


def reference(n_frames: int = chain.N_FRAMES, knee_deg: float = KNEE_DEG, lag_s: float = LAG_S) -> Reference:
    """The movement of the stand-in, earlier by `lag_s` and with a right knee bent `knee_deg` more."""
    truth = reference_of_fit(fitted(n_frames), "optical markers")
    angles = {**truth.angles_deg, "knee_flexion_r": truth.angles_deg["knee_flexion_r"] + knee_deg}
    return dataclasses.replace(truth, time_s=truth.time_s - lag_s, angles_deg=angles)


def saved(folder: Path, name: str, truth: Reference) -> Path:
    truth.save(folder / name)
    return folder / name


def done(run) -> int:
    return {t.table: t.done for t in run.tables}["KinematicError"]


# ------------------------------------------------------------------------------------------------------ the tables
def test_a_reference_that_is_added_later_gives_the_errors_that_were_put_in(tables: None, tmp_path: Path):
    first, second = (chain.small_video(tmp_path, n) for n in ("walk1", "walk2"))
    (number,) = register(first, population="healthy", camera_motion="handheld")
    register(second)
    assert done(populate()) == 0
    assert frames.validation_frame().empty
    added = add_reference(number, saved(tmp_path, "truth.npz", reference()), dataset="LAB")
    assert (added.status, added.video_id) == ("registered", number)
    run = populate()
    assert done(run) == 1
    row = validation.KinematicError.fetch1()
    assert row["error_lag"] == pytest.approx(LAG_S, abs=1e-3)
    assert row["rte"] == pytest.approx(0.0, abs=0.01)
    # She walks across the picture from right to left, the camera on her left.
    assert (row["error_view_left"], row["error_view_right"]) == ("ipsilateral", "contralateral")
    joints = {r["error_joint"]: r for r in validation.KinematicError.Joint.to_dicts()}
    assert joints["knee_flexion_r"]["joint_bias"] == pytest.approx(-KNEE_DEG, abs=0.05)
    assert joints["knee_flexion_r"]["joint_median_abs"] == pytest.approx(KNEE_DEG, abs=0.05)
    assert joints["knee_flexion_r"]["joint_sd"] < 0.2
    assert joints["knee_flexion_l"]["joint_median_abs"] < 0.1
    assert joints["knee_flexion_l"]["joint_correlation"] > 0.999
    assert joints["knee_flexion_l"]["joint_within_90"] is None  # the stand-in states no standard deviation
    frame = frames.validation_frame()
    about = frame[["dataset", "population", "activity", "camera", "trial"]].drop_duplicates()
    assert about.to_numpy().tolist() == [["LAB", "healthy", "walking", "handheld", f"{number} walk1"]]
    (knee,) = frame.query("joint == 'knee_flexion' and side == 'r'").to_dict("records")
    assert knee["bias_deg"] == pytest.approx(-KNEE_DEG, abs=0.05)
    assert knee["view"] == "contralateral"
    # The rows are what the library says of the same arrays.
    direct = compare(fitted(), reference())
    stored = {j["error_joint"]: j["joint_rms"] for j in joints.values()}
    assert stored == pytest.approx({j.joint: j.rms_deg for j in direct.joints}, abs=1e-3)
    assert not populate().did_something


def test_another_file_of_a_source_is_another_row_and_takes_the_place(tables: None, tmp_path: Path):
    (number,) = register(chain.small_video(tmp_path, "walk"))
    old, new = saved(tmp_path, "old.npz", reference()), saved(tmp_path, "new.npz", reference(knee_deg=9.0))
    add_reference(number, old, dataset="LAB")
    populate()
    assert add_reference(number, old).status == "known"
    replaced = add_reference(number, new)
    assert replaced.status == "replaced"
    assert "no longer current" in replaced.note
    assert done(populate()) == 1
    assert len(validation.ReferenceKinematics()) == len(validation.KinematicError()) == 2
    assert set(validation.ReferenceKinematics.to_arrays("dataset")) == {"LAB"}
    assert _knee_bias() == pytest.approx(-9.0, abs=0.05)
    assert add_reference(number, old, dataset="OTHER").status == "updated"
    assert not populate().did_something
    assert _knee_bias() == pytest.approx(-KNEE_DEG, abs=0.05)
    assert set(frames.validation_frame()["dataset"]) == {"OTHER"}
    # Another instrument does not take the place of the first.
    assert add_reference(number, new, source="several cameras").status == "registered"
    assert done(populate()) == 1
    assert set(frames.validation_frame()["trial"]) == {
        f"{number} walk against optical markers",
        f"{number} walk against several cameras",
    }


def test_every_result_of_a_person_goes_with_them_and_nothing_of_another(tables: None, tmp_path: Path):
    first, second = (chain.small_video(tmp_path, n) for n in ("walk1", "walk2"))
    truth = saved(tmp_path, "truth.npz", reference())
    for path, subject in ((first, "P001"), (second, "P002")):
        (number,) = register(path, subject=subject)
        add_reference(number, truth)
    populate()
    tables_used = [t for t in pbl_schemas.computed_tables() if is_wanted(t)]
    results = {t.__name__: len(t()) for t in tables_used}
    assert set(results.values()) == {2}
    (lab.Subject & {"subject": "P001"}).delete(prompt=False, part_integrity="cascade")
    assert {t.__name__: len(t()) for t in tables_used} == dict.fromkeys(results, 1)
    lab.Subject.delete(prompt=False, part_integrity="cascade")
    rows_of = everything_but_refreshes()
    kept = {name: len(rows) for name, rows in rows_of.items() if rows and ".#" not in name and ".~" not in name}
    assert kept == {}


def _knee_bias() -> float:
    frame = frames.validation_frame()
    (row,) = frame.query("joint == 'knee_flexion' and side == 'r'").to_dict("records")
    return float(row["bias_deg"])


def test_a_reference_of_another_time_is_one_error_row(tables: None, tmp_path: Path):
    paths = [chain.small_video(tmp_path, n) for n in ("walk1", "walk2")]
    numbers = register(*paths)
    add_reference(numbers[0], saved(tmp_path, "elsewhere.npz", reference(lag_s=-900.0)))
    add_reference(numbers[1], saved(tmp_path, "truth.npz", reference()))
    run = populate()
    assert {t.table: t.errors for t in run.tables if t.errors} == {"KinematicError": {"REFERENCE_INPUT": 1}}
    assert done(run) == 1
    (error,) = pipeline_status().errors
    assert (error.table, error.code, error.about) == ("KinematicError", "REFERENCE_INPUT", "walk1.mp4")
    assert "no common time" in error.found
    # On the clock of the video it takes the other's place, and the error row goes with the next populate.
    assert add_reference(numbers[0], tmp_path / "elsewhere.npz", shift_s=-900.0).status == "replaced"
    assert done(populate()) == 1
    assert not pipeline_status().errors
    lags = sorted(validation.KinematicError.to_arrays("error_lag"))
    assert lags == pytest.approx([0.0, LAG_S], abs=1e-3)


# ------------------------------------------------------------------------------------------------------- the files
def test_a_video_by_number_path_copy_or_name(tables: None, tmp_path: Path):
    path = chain.small_video(tmp_path, "walk")
    (number,) = register(path)
    copy = tmp_path / "elsewhere" / "copy.mp4"
    copy.parent.mkdir()
    shutil.copy(path, copy)
    for about in (number, str(number), path, copy, path.name):
        assert find_video(about) == number
    for unknown in (number + 1, "nobody.mp4", "9" * 250):
        with pytest.raises(PblError, match="DB_NOT_FOUND"):
            find_video(unknown)
    other = tmp_path / "other"
    other.mkdir()
    register(chain.small_video(other, "walk", n=200))
    with pytest.raises(PblError, match="USAGE"):
        find_video(path.name)
    assert len(video.Video()) == 2


def test_files_of_every_kind_are_references(tmp_path: Path):
    truth = reference()
    assert read_reference(saved(tmp_path, "a.npz", truth)).source == "optical markers"
    assert read_reference(tmp_path / "a.npz", source="inertial sensors").source == "inertial sensors"
    fitted().save(tmp_path / "b.fit.npz")
    assert read_reference(tmp_path / "b.fit.npz").source == "several cameras"
    dataclasses.replace(fitted(), camera_position_m=np.full(3, np.nan)).save(tmp_path / "c.fit.npz")
    assert read_reference(tmp_path / "c.fit.npz").source == "optical markers"
    walker = synthesise(SynthSpec(seconds=1.0, noise="none"))
    walker.truth.save(tmp_path / "e.truth.npz")
    known = read_reference(tmp_path / "e.truth.npz")
    knee = list(walker.truth.joint_names).index("knee_angle_r")
    np.testing.assert_allclose(known.angles_deg["knee_flexion_r"], -np.degrees(walker.truth.qpos[:, knee]))
    assert known.pelvis_m is not None
    np.testing.assert_allclose(known.pelvis_m, walker.truth.pelvis_m)
    assert known.source == "synthetic"
    lines = ["nRows=3", "nColumns=2", "inDegrees=yes", "endheader", "time\tknee_angle_r"]
    lines += [f"{0.1 * i}\t{20 + i}" for i in range(3)]
    (tmp_path / "d.mot").write_text("\n".join(lines))
    np.testing.assert_allclose(read_reference(tmp_path / "d.mot").angles_deg["knee_flexion_r"], [20, 21, 22])
    for name, content, code in (("absent.npz", None, "FILE_MISSING"), ("walk.trc", "x", "FILE_FORMAT")):
        if content:
            (tmp_path / name).write_text(content)
        with pytest.raises(PblError, match=code):
            read_reference(tmp_path / name)
    nothing = Reference("none", "optical markers", "qpos", np.zeros(0), {})
    with pytest.raises(PblError, match="REFERENCE_INPUT"):
        read_reference(saved(tmp_path, "none.npz", nothing))


def test_rotations_of_bodies_are_a_reference(shared_data: Path):
    found = read_reference(SHARED / "real" / "video_mocap" / "walk" / "sample_mocap.json.gz")
    assert found.convention == "body_rotations"
    assert np.nanmax(found.angles_deg["knee_flexion_r"]) > 40


# ----------------------------------------------------------------------------------------------------- the command
def test_the_command_says_what_to_do_where_there_is_nothing(tables: None):
    result = pbl("validate")
    assert result.code == 0, result.err
    assert "pbl validate add VIDEO --reference FILE" in result.out


def test_the_command_from_reference_to_tables(tables: None, tmp_path: Path):
    path = chain.small_video(tmp_path, "walk")
    (number,) = register(path, population="healthy")
    truth = saved(tmp_path, "truth.npz", reference())
    result = pbl("validate", "add", path, "--reference", truth, "--dataset", "LAB")
    assert result.code == 0, result.err
    assert f"video_id {number}: reference" in result.out
    assert "next: pbl populate" in result.out
    populate()
    result = pbl("validate", "--out", tmp_path / "out", "--dataset", "LAB", "--where", "population=healthy")
    assert result.code == 0, result.err
    for word in ("LAB", "control", "Knee Flexion"):
        assert word in result.out
    assert {p.suffix for p in (tmp_path / "out").iterdir()} >= {".csv", ".tex", ".html"}
    errors = pd.read_csv(tmp_path / "out" / "errors.csv").fillna({"side": ""})
    pd.testing.assert_frame_equal(errors, frames.validation_frame(), check_dtype=False)
    cells = pd.read_csv(tmp_path / "out" / "summary.csv").to_dict("records")
    rte = {c["column"]: c for c in cells if c["row"] == "RTE (cm)"}
    assert (rte["LAB static"]["n"], rte["MMMC handheld"]["n"]) == (1, 0)
    assert "6.44" in rte["MMMC handheld"]["paper"]
    with np.load(tmp_path / "out" / "curves.npz") as curves:
        knee = curves["knee_flexion_reference"] - curves["knee_flexion_fit"]
        right = np.char.find(curves["knee_flexion_cycle"], "right") >= 0
        assert 0 < right.sum() < len(right)
        np.testing.assert_allclose(knee[right], KNEE_DEG, atol=0.3)
        np.testing.assert_allclose(knee[~right], 0.0, atol=0.3)
    (known,) = ingest([path], VisitRecord("P001", population="patient"))
    assert (known.status, set(frames.validation_frame()["population"])) == ("updated", {"patient"})
    assert "None of" in pbl("validate", "--where", "population=healthy").out
    assert pbl("validate", "--where", "shoe=red").code != 0
    assert pbl("validate", "--reference", truth).code == 2


def test_the_command_on_files_needs_no_database(tmp_path: Path):
    fitted().save(tmp_path / "walk.fit.npz")
    truth = saved(tmp_path, "truth.npz", reference())
    result = pbl("validate", tmp_path / "walk.fit.npz", "--reference", truth, "--out", tmp_path / "out")
    assert result.code == 0, result.err
    assert "Knee Flexion" in result.out
    assert list((tmp_path / "out").glob("*.html"))
    assert pbl("validate", tmp_path / "walk.fit.npz").code == 2
    some = pbl("validate", tmp_path / "absent.fit.npz", tmp_path / "walk.fit.npz", "--reference", truth)
    assert some.code == 1
    assert "FILE_MISSING" in some.err
    assert "Knee Flexion" in some.out
    late = pbl("validate", tmp_path / "walk.fit.npz", "--reference", truth, "--shift", 60)
    assert (late.code, "REFERENCE_INPUT" in late.err) == (1, True)
