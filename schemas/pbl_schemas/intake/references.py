"""Registration of reference movements (`pbl validate add`)."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import fields_of, sha256_of
from pbl_pipeline.names import check_label, whole_number
from pbl_pipeline.paramset import canonical_json
from pbl_pipeline.temporary import new_folder

from .. import fit, validation, video
from ..rows import utc_now
from ..stored_files import file_ref, stored_file
from ..transactions import repeated

if TYPE_CHECKING:
    from pbl_pipeline import validation as lib

#: Dataset of references that were registered without one.
UNNAMED = "unnamed"

#: Longest texts that the columns hold.
_LONGEST = {"dataset": 32, "source": 64, "origin": 1000}


@dataclasses.dataclass(frozen=True)
class Added:
    """The outcome for a reference."""

    video_id: int
    reference: str
    status: str  # registered, replaced (an older one of its source is outdated), updated (also: current again), known
    note: str


def read_reference(path: str | Path, source: str | None = None, shift_s: float = 0.0) -> lib.Reference:
    """Return the library's `Reference` from a file of one of several formats.

    Accepted: the library's own npz, a `fit.npz` of ours (from markers or several cameras), the `truth.npz` of
    `pbl synth`, rotations of bodies (`.json.gz`), OpenSim `.mot` and `.sto`.

    Raises `PblError` FILE_MISSING, FILE_FORMAT (also what the readers raise).

    `source`: instrument; None: as the file states. A fit without a camera comes from markers, one with cameras from
    several. `shift_s`: added to its time stamps (s), so that they are on the clock of the video.
    """
    from pbl_pipeline import validation as lib

    path = Path(path)
    if not path.is_file():
        raise _no_reference("FILE_MISSING", "no such file", "check the path", path)
    readers = {
        ".npz": _read_npz,
        ".json": lib.reference_of_bodies,
        ".json.gz": lib.reference_of_bodies,
        ".mot": lib.reference_of_mot,
        ".sto": lib.reference_of_mot,
    }
    reader = next((read for ending, read in readers.items() if path.name.lower().endswith(ending)), None)
    if reader is None:
        found = f"a file that ends in {path.suffix or 'nothing'}"
        next_step = "see docs/files.md, section on references; markers (.trc) go through `pbl fit` first"
        raise _no_reference("FILE_FORMAT", found, next_step, path)
    found = reader(path)
    if not len(found.time_s) or not found.angles_deg:
        raise PblError(
            "REFERENCE_INPUT",
            found=f"{len(found.time_s)} samples of {len(found.angles_deg)} angles",
            expected="joint angles over time",
            next_step="export the reference again",
            key=str(path),
        )
    return dataclasses.replace(found, source=source or found.source, time_s=found.time_s + shift_s)


def _no_reference(code: str, found: str, next_step: str, path: Path) -> PblError:
    expected = "a reference: .npz, fit.npz, truth.npz, .json.gz, .mot or .sto"
    return PblError(code, found=found, expected=expected, next_step=next_step, key=str(path))


def _read_npz(path: Path) -> lib.Reference:
    from pbl_pipeline import validation as lib

    fields = fields_of(path)
    if "qpos" not in fields:
        return lib.Reference.load(path)
    if "event_time_s" in fields:
        from pbl_pipeline.synthetic import Truth

        truth = Truth.load(path)
        return lib.reference_of_qpos(
            path.stem, "synthetic", truth.time_s, truth.joint_names, truth.qpos, truth.pelvis_m
        )
    from pbl_pipeline.fit import TrialFit

    fitted = TrialFit.load(path)
    by_markers = bool(np.isnan(fitted.camera_position_m).all())
    return lib.reference_of_fit(fitted, "optical markers" if by_markers else "several cameras")


@repeated
def add_reference(
    about: int | str | Path,
    path: str | Path,
    dataset: str | None = None,
    source: str | None = None,
    origin: str | None = None,
    shift_s: float = 0.0,
) -> Added:
    """Register the reference movement of a video. `pbl populate` then computes the errors of its fits.

    The same file is registered once; another file of the same source takes its place, and the older row with its
    errors stays, no longer current.

    Raises `PblError` DB_NOT_FOUND for an unknown video, USAGE for a name that several videos have or a text too long,
    and what `read_reference` raises.

    `about`: number, path or unique file name of the video. `dataset`, `source`, `origin`: collection it is reported
    with (None: as it was, else "unnamed"), instrument (None: as the file states), origin (None: the path).
    """
    for what, text in (("dataset", dataset), ("source", source), ("origin", origin)):
        if text is not None:
            check_label(f"--{what}", text, _LONGEST[what], least=1)
    video_id = find_video(about)
    path = Path(path).absolute()
    truth = read_reference(path, source, shift_s)
    check_label("source", truth.source, _LONGEST["source"], least=1)
    sha256 = sha256_of(path)
    what = {"source": truth.source, "convention": truth.convention, "sha256": sha256, "shift_s": float(shift_s)}
    key = {"video_id": video_id, "reference": hashlib.sha256(canonical_json(what).encode()).hexdigest()[:16]}
    of_source = {"video_id": video_id, "reference_source": truth.source}
    table = validation.ReferenceKinematics
    with table.connection.transaction:
        current = (table & of_source & {"reference_current": True}).to_dicts(order_by="reference_created")
        older = [row for row in current if row["reference"] != key["reference"]]
        for row in older:
            table.update1({k: row[k] for k in table.primary_key} | {"reference_current": False})
        known = (table & key).to_dicts()
        given: dict[str, Any] = {k: v for k, v in (("dataset", dataset), ("reference_origin", origin)) if v is not None}
        if known:
            given["reference_current"] = True
            changed = {k: v for k, v in given.items() if known[0][k] != v}
            if changed:
                table.update1({**key, **changed})
            status = "updated" if changed else "known"
            note = ", ".join(f"{k} is now {v}" for k, v in changed.items()) or "nothing was inserted"
            return Added(video_id, key["reference"], status, note)
        kept = older[-1]["dataset"] if older else UNNAMED
        row = {**key, **of_source, "dataset": dataset or kept, "reference_shift": shift_s}
        _insert(row, truth, path, sha256, origin)
    note = f"{len(truth.time_s)} samples, {len(truth.angles_deg)} angles, source {truth.source}"
    note = "; ".join([note, *truth.notes])
    if older:
        note += f"; the older reference {', '.join(r['reference'] for r in older)} is no longer current"
    return Added(video_id, key["reference"], "replaced" if older else "registered", note)


def add_trial(
    about: int | str | Path,
    trial: int,
    dataset: str | None = None,
    origin: str | None = None,
    shift_s: float = 0.0,
    fit_method: str | None = None,
) -> Added:
    """Register the current fit of another recording in the tables, of several cameras or laboratory markers, as the
    reference of a video, by `add_reference`. The reference stays unchanged when that fit is redone.

    Raises `PblError` DB_NOT_FOUND if it has no current fit; USAGE where it is a video of one camera, or has several
    fits; what `add_reference` raises.

    `trial`: number of the trial of several cameras, or of the marker recording. `fit_method`: key of the fit's method,
    where the trial was fitted by several.
    """
    trial = fit.trial_of(trial)
    current = fit.current().proj() * fit.FitSet.proj("fit_set_kind")
    named = {"fit_method": fit_method} if fit_method is not None else True
    rows = (fit.SessionFit.Trial * current & {"video_id": trial} & named).to_dicts()
    if not rows:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no current fit of video_id {trial}",
            expected="a trial of several cameras, or a marker recording, that is fitted",
            next_step=f"`pbl populate`; `pbl why {trial}` says where it stands",
            key=f"video_id={trial}",
        )
    if len(rows) > 1 or rows[0]["fit_set_kind"] == fit.SINGLE:
        kinds = ", ".join(f"{r['fit_set_kind']} by {r['fit_method']}" for r in rows)
        found = f"video_id {trial}: {kinds}"
        next_step = "name the method of the fit, or a trial whose fit can be a reference"
        raise PblError("USAGE", found, "one fit, of several cameras or of markers", next_step, key=f"video_id={trial}")
    (row,) = rows
    said = origin or f"fit of video_id {trial}, set {row['fit_set']}, {row['fit_method']}"
    with stored_file(file_ref(row["trial_file"])) as path:
        return add_reference(about, path, dataset, origin=said, shift_s=shift_s)


def _insert(row: dict[str, Any], truth: lib.Reference, path: Path, sha256: str, origin: str | None) -> None:
    with new_folder() as folder:
        truth.save(folder / "reference.npz")
        validation.ReferenceKinematics.insert1(
            {
                **row,
                "reference_convention": truth.convention,
                "reference_name": path.name[-255:],
                "reference_sha256": sha256,
                "reference_origin": origin or str(path)[-1000:],
                "reference_n": len(truth.time_s),
                "reference_start": float(truth.time_s[0]),
                "reference_end": float(truth.time_s[-1]),
                "reference_joints": list(truth.angles_deg),
                "reference_current": True,
                "reference_created": utc_now(),
                "reference_file": folder / "reference.npz",
            }
        )


def find_video(about: int | str | Path) -> int:
    """Return the number of a registered video by its number, path, or file name. Raises DB_NOT_FOUND, USAGE."""
    from pbl_pipeline.video import check_file

    text = str(about)
    if (number := whole_number(text)) is not None:
        found = (video.Video & {"video_id": number}).to_arrays("video_id")
    else:
        path = Path(text).absolute()
        found = (video.Video & {"video_path": str(path)}).to_arrays("video_id")
        if not len(found) and path.is_file():
            found = (video.Video & {"video_sha256": sha256_of(check_file(path))}).to_arrays("video_id")
        if not len(found):
            found = (video.Video & {"video_name": Path(text).name}).to_arrays("video_id")
    if len(found) == 1:
        return int(found[0])
    if len(found):
        raise PblError(
            "USAGE",
            found=f"{len(found)} videos of that name: video_id {', '.join(str(v) for v in sorted(found))}",
            expected="one video",
            next_step="name it by its number",
            key=text,
        )
    expected = "number, path or file name of a registered video"
    next_step = "register it first: `pbl ingest`, which prints the number"
    raise PblError("DB_NOT_FOUND", "no such video", expected, next_step, key=text)
