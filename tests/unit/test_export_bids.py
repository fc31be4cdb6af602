"""Motion-BIDS: what the files hold, and what the official validator says of them."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.export import ExportOptions, Labels, bids, write_export
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import Condition, gait_metrics
from pbl_pipeline.visit import Recording, Visit
from tests.exported import marked_fit

_PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
#: Beside the table of participants; validators leave hidden files out.
LOCK = ".participants.lock"
_VALIDATOR = shutil.which("bids-validator-deno", path=_PATH)


@pytest.fixture(scope="module")
def fit() -> TrialFit:
    """A walk of which two frames have no pose."""
    fit = marked_fit()
    qpos = fit.qpos.copy()
    qpos[3:5] = np.nan
    return dataclasses.replace(fit, qpos=qpos)


@pytest.fixture(scope="module")
def visit(fit: TrialFit) -> Visit:
    """Two walks and a recording of which nothing was stated."""
    names = {"walk one": Condition("walking"), "walk2": Condition("walking"), "other": Condition()}
    trials = [Recording.of(n, dataclasses.replace(fit, name=n), condition=c) for n, c in names.items()]
    metrics = gait_metrics([r.fit for r in trials if r.fit is not None])
    return Visit(tuple(r.with_measured(m) for r, m in zip(trials, metrics.trials, strict=True)), measures=metrics)


@pytest.fixture(scope="module")
def dataset(visit: Visit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two visits of one person and one of another."""
    root = tmp_path_factory.mktemp("bids")
    for subject, label in (("P-001", "2026-03-01"), ("P-001", "2026-06-01"), ("P_002", "2026-03-01")):
        options = ExportOptions(bids=(root / "bids", Labels.of(subject, label)))
        write_export(visit, ["bids"], root / subject / label, options)
    return root / "bids"


def test_the_names_of_the_files(dataset: Path):
    found = sorted(p.relative_to(dataset).as_posix() for p in dataset.rglob("*") if p.is_file() and p.name != LOCK)
    of_visit = [
        f"task-{task}{system}{run}_{table}.{ending}"
        for task, run in (("unknown", ""), ("walking", "_run-1"), ("walking", "_run-2"))
        for system, table in (("", "events"), ("_tracksys-video", "channels"), ("_tracksys-video", "motion"))
        for ending in ("json", "tsv")
    ]
    visits = (("P001", "20260301"), ("P001", "20260601"), ("P002", "20260301"))
    expected = [f"sub-{s}/ses-{v}/motion/sub-{s}_ses-{v}_{name}" for s, v in visits for name in of_visit]
    assert found == sorted([*expected, "README.md", "dataset_description.json", "participants.tsv"])
    assert (dataset / "participants.tsv").read_text() == "participant_id\nsub-P001\nsub-P002\n"


def test_channels_hold_the_fit_and_its_standard_deviations(dataset: Path, fit: TrialFit):
    stem = dataset / "sub-P001/ses-20260301/motion/sub-P001_ses-20260301_task-walking_tracksys-video_run-1"
    channels: Any = pd.read_csv(f"{stem}_channels.tsv", sep="\t", keep_default_na=False)
    values = pd.read_csv(f"{stem}_motion.tsv", sep="\t", header=None, names=channels["name"], na_values="n/a")
    assert len(values) == len(fit.time_s)
    np.testing.assert_allclose(values["time"], fit.time_s, atol=1e-6)
    hip = list(fit.joint_names).index("hip_flexion_r")
    np.testing.assert_allclose(values["hip_flexion_r"], np.degrees(fit.qpos[:, hip]), atol=1e-5)
    known = np.isfinite(fit.qpos).all(axis=1)
    sd = np.where(known, np.degrees(fit.qpos_sd[:, hip]), np.nan)
    np.testing.assert_allclose(values["hip_flexion_r_sd"], sd, atol=1e-5)
    assert values["hip_flexion_r"].isna().tolist() == (~known).tolist()
    first = fit.marker_names[0]
    np.testing.assert_allclose(values[[f"{first}_{a}" for a in "xyz"]], fit.markers_world_m[:, 0], atol=1e-6)
    row = channels.set_index("name").loc["hip_flexion_r_sd"]
    assert (row["type"], row["units"], row["tracked_point"]) == ("MISC", "deg", "hip_flexion_r")
    assert channels.set_index("name").loc["pelvis_tx", ["type", "component", "units"]].tolist() == ["POS", "x", "m"]
    about = json.loads(Path(f"{stem}_motion.json").read_text())
    assert about["TaskName"] == "walking"
    counts = [v for k, v in about.items() if k.endswith("ChannelCount") and not k.startswith("Motion")]
    assert about["MotionChannelCount"] == len(channels) == sum(counts)
    assert about["SamplingFrequency"] == pytest.approx(1.0 / np.median(np.diff(fit.time_s)), abs=1e-5)


def test_a_number_that_no_table_shows_exactly_leaves_missing_ones_missing(visit: Visit, tmp_path: Path):
    (walk,) = visit.recordings[:1]
    assert walk.fit is not None
    far = walk.fit.markers_world_m.copy()
    far[:, 0, 0], far[2, 0, 1] = 1e12, np.nan
    fit = dataclasses.replace(walk.fit, markers_world_m=far)
    one = Visit((dataclasses.replace(walk, load_fit=lambda: fit),), measures=visit.measures)
    write_export(one, ["bids"], tmp_path, ExportOptions())
    (path,) = tmp_path.rglob("*_motion.tsv")
    assert "1000000000000.000000\tn/a\t" in path.read_text().splitlines()[2]


def test_events_are_those_of_the_gait(dataset: Path, visit: Visit):
    path = dataset / "sub-P002/ses-20260301/motion/sub-P002_ses-20260301_task-walking_run-1_events.tsv"
    found = pd.read_csv(path, sep="\t")
    measured = visit.recordings[0].measured
    assert measured is not None
    events = sorted(measured.events.events, key=lambda e: e.time_s)
    assert len(events) > 4
    np.testing.assert_allclose(found["onset"], [e.time_s for e in events], atol=1e-6)
    assert found["trial_type"].tolist() == [f"{e.side}_{e.event}" for e in events]


def test_what_a_lab_added_to_the_data_set_stays(visit: Visit, tmp_path: Path):
    root = tmp_path / "bids"
    root.mkdir()
    own = "participant_id\tage\tsex\nsub-P003\t71\tF\n"
    (root / "participants.tsv").write_text(own)
    (root / "README.md").write_text("A walk a day.\n")
    (root / "dataset_description.json").write_text('{"Name": "Walks", "BIDSVersion": "1.10.0", "Authors": ["A"]}')
    for label in ("1", "2"):
        write_export(visit, ["bids"], tmp_path / label, ExportOptions(bids=(root, Labels("P001", label))))
    assert (root / "participants.tsv").read_text() == own.replace("sub-P003", "sub-P001\tn/a\tn/a\nsub-P003")
    assert (root / "README.md").read_text() == "A walk a day.\n"
    assert json.loads((root / "dataset_description.json").read_text())["Authors"] == ["A"]


@pytest.mark.parametrize(
    "table", ["participant_id\tage\n".encode("utf-16"), b"name\n1\n", b"participant_id\nsub-\xff\n"]
)
def test_a_table_of_participants_that_cannot_be_read_is_left(visit: Visit, tmp_path: Path, table: bytes):
    (tmp_path / "bids").mkdir()
    (tmp_path / "bids/participants.tsv").write_bytes(table)
    with pytest.raises(PblError, match=r"^EXPORT_INPUT: "):
        write_export(visit, ["bids"], tmp_path, ExportOptions(overwrite=True))
    assert (tmp_path / "bids/participants.tsv").read_bytes() == table
    assert not list((tmp_path / "bids").rglob("*_motion.tsv"))


@pytest.mark.parametrize(
    ("link", "code"),
    [
        ("bids/sub-P001", "FILE_UNWRITABLE"),
        ("bids/sub-P001/ses-1/motion", "FILE_UNWRITABLE"),
        ("bids", "FILE_UNWRITABLE"),
        ("out/walk2", "FILE_UNWRITABLE"),
        ("bids/participants.tsv", "EXPORT_INPUT"),
    ],
)
def test_nothing_is_written_to_where_a_link_leads(visit: Visit, tmp_path: Path, link: str, code: str):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "participants.tsv").write_text("participant_id\n")
    place = tmp_path / link
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(elsewhere / "participants.tsv" if place.suffix else elsewhere)
    options = ExportOptions(bids=(tmp_path / "bids", Labels("P001", "1")), overwrite=True)
    with pytest.raises(PblError, match=rf"^{code}: "):
        write_export(visit, ["mot", "bids"], tmp_path / "out", options)
    assert place.is_symlink()
    assert [p.name for p in elsewhere.iterdir()] == ["participants.tsv"]
    assert (elsewhere / "participants.tsv").read_text() == "participant_id\n"


def test_links_in_the_place_of_files_are_replaced_and_a_lab_s_own_are_kept(visit: Visit, tmp_path: Path):
    """DataLad keeps a data set's files as links, which lead nowhere as long as their content is not here."""
    for name in ("bids/README.md", "out/export.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(tmp_path / "secret")
    options = ExportOptions(bids=(tmp_path / "bids", Labels("P001", "1")), overwrite=True)
    write_export(visit, ["bids"], tmp_path / "out", options)
    assert (tmp_path / "bids/README.md").is_symlink()
    assert not (tmp_path / "out/export.json").is_symlink()
    assert not (tmp_path / "secret").exists()


def test_exports_at_the_same_time_lose_no_participant(visit: Visit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    real, read = bids._with_participant, threading.Event()

    def slowly(path: Path, participant: str) -> bytes:
        found = real(path, participant)
        first, _ = not read.is_set(), read.set()
        time.sleep(0.5 * first)  # the first export has read the table when the second begins
        return found

    def export(name: str) -> None:
        write_export(visit, ["bids"], tmp_path / name, ExportOptions(bids=(tmp_path / "bids", Labels(name, "1"))))

    monkeypatch.setattr(bids, "_with_participant", slowly)
    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(export, "P001")
        assert read.wait(60)
        second = threads.submit(export, "P002")
        first.result()
        second.result()
    assert (tmp_path / "bids/participants.tsv").read_text() == "participant_id\nsub-P001\nsub-P002\n"


def test_a_visit_of_its_own_is_in_the_folder_bids(visit: Visit, tmp_path: Path):
    write_export(visit, ["bids"], tmp_path / "out", ExportOptions())
    assert (tmp_path / "out/bids/sub-01/motion").is_dir()
    listed = json.loads((tmp_path / "out/export.json").read_text())["files"]
    assert "bids/dataset_description.json" in listed


@pytest.mark.parametrize(("subject", "label"), [("P001", "20260301"), ("---", "a")])
def test_labels_that_are_alike_or_empty_are_refused(visit: Visit, dataset: Path, tmp_path: Path, subject, label):
    before = sorted(dataset.rglob("*"))
    with pytest.raises(PblError, match=r"^EXPORT_INPUT: "):
        write_export(visit, ["bids"], tmp_path / "new", ExportOptions(bids=(dataset, Labels.of(subject, label))))
    assert sorted(dataset.rglob("*")) == before


@pytest.mark.needs_extra
@pytest.mark.skipif(_VALIDATOR is None, reason="bids-validator-deno is not installed")
def test_the_official_validator_finds_no_error(dataset: Path):
    assert _VALIDATOR is not None
    done = subprocess.run([_VALIDATOR, str(dataset), "--format", "json"], capture_output=True, text=True, check=False)
    issues = json.loads(done.stdout)["issues"]["issues"]
    assert [i for i in issues if i["severity"] == "error"] == []
    assert done.returncode == 0
    # It does find what is wrong.
    broken = dataset.parent / "broken"
    shutil.copytree(dataset, broken)
    for path in broken.rglob("*_channels.tsv"):
        path.write_text(path.read_text().replace("JNTANG", "ANGLE"))
    assert subprocess.run([_VALIDATOR, str(broken)], capture_output=True, check=False).returncode != 0
