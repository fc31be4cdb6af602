"""Registering laboratory markers: what `pbl ingest --markers` does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline import methods as library_methods
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import check_label

from . import fit, gdi, ingest, video
from ._datajoint import DuplicateError
from .conditions import set_condition, set_height
from .ingest import Ingested, Methods, Visit
from .method_rows import method_row, resolve_method
from .stored_files import new_folder

if TYPE_CHECKING:
    from pbl_pipeline.body import MarkerSet
    from pbl_pipeline.fit import MarkerFile

#: Method of the fit that markers get where nobody names one (`pbl_pipeline.fit.default_method`).
DEFAULT_FIT = "markers"


def ingest_markers(
    paths: Sequence[str | Path],
    visit: Visit,
    marker_set: str | None = None,
    up: str = "y",
    methods: Methods | None = None,
) -> list[Ingested]:
    """Register files of laboratory markers (`.trc`, or the `.npz` of docs/files.md) as recordings of one session.

    Each is read here and a copy, in metres with z up, is kept in the store: the file itself is not needed again. They
    are fitted together, never with a video of the session. A file that is registered already takes activity, pace,
    population and the methods that are named.

    Parameters
    ----------
    marker_set
        Name of a shipped marker set, or the path of a table (`.csv`) of the laboratory's own; needed for `.trc`.
    up
        Vertical axis of `.trc` files, "y" or "z".

    Raises
    ------
    PblError
        USAGE for a subject code that could be a name, a label too long, or a visit with a camera or a person's number;
        MARKER_SET_UNKNOWN, FILE_FORMAT for the marker set; SOLVER_UNKNOWN, NORM_UNKNOWN for unknown methods. Errors of
        single files are in the result: FILE_MISSING, FILE_FORMAT, FIT_INPUT, MARKER_SET_UNKNOWN, VIDEO_DUPLICATE,
        USAGE.
    """
    ingest.check_visit(visit)
    if visit.camera_file is not None or visit.camera_motion is not None or visit.person is not None:
        raise _usage("a camera or a person's number for markers", "neither: markers are one person's, in the world")
    table_file = Path(marker_set) if marker_set is not None and marker_set.lower().endswith(".csv") else None
    table = _marker_set(marker_set, table_file)
    methods = methods or Methods()
    if methods.tracking or methods.keypoint or methods.subject:
        raise _usage("a method of tracking or keypoints for markers", "methods of the fit, of events and of the index")
    chosen = _resolve(methods)
    done = []
    for path in (Path(p).absolute() for p in paths):
        try:
            ingest.check_path(path)
            done.append(_ingest_one(path, visit, table, table_file, up, chosen, methods))
        except PblError as error:
            done.append(Ingested(path, "refused", error=error))
    return done


def _marker_set(name: str | None, table_file: Path | None) -> MarkerSet | None:
    from pbl_pipeline.body import load_marker_set, marker_set

    if name is None:
        return None
    if table_file is None:
        return marker_set(name)
    check_label("--marker-set", table_file.stem, 64)
    return load_marker_set(table_file)


def _resolve(named: Methods) -> dict[str, str]:
    """Keys of the method rows, defaults filled in."""
    return {
        "fit_method": resolve_method(fit.FitMethod, named.fit or DEFAULT_FIT),
        "gait_method": ingest.gait_method(named.gait),
        **gdi.resolve(named.gdi, named.norm),
    }


def _ingest_one(
    path: Path,
    visit: Visit,
    table: MarkerSet | None,
    table_file: Path | None,
    up: str,
    chosen: dict[str, str],
    named: Methods,
) -> Ingested:
    from pbl_pipeline.fit import check_trial, read_markers
    from pbl_pipeline.video import sha256_of

    found = read_markers(path, table, up)
    sha256 = sha256_of(path)
    about = {
        "recording_marker_set": found.markers.name,
        "marker_table_sha256": sha256_of(table_file) if table_file is not None else "",
    }
    if known := ingest.with_sha256(sha256):
        return _known(path, known, visit, about, chosen, named)
    method = library_methods.stored(**method_row(fit.FitMethod, chosen))
    _, share = check_trial(found.trial, path.stem, method, found.markers)
    time = found.trial.time_s
    recording = {
        **about,
        "vertical_axis": up if path.suffix.lower() == ".trc" else "z",
        "recording_n_frames": len(time),
        "recording_n_markers": int(np.sum(np.any(found.trial.confidence > 0, axis=0))),
        "recording_duration": float(time[-1] - time[0]),
        "recording_in_view_share": share,
    }
    size = path.stat().st_size

    def insert() -> int:
        session_id = ingest.session_of(visit)
        _check_same_set(session_id, about, path)
        number = ingest.next_id(video.Video, "video_id")
        video.Video.insert1(ingest.video_row(number, session_id, path, sha256, size, visit.activity, video.NO_CAMERA))
        set_condition(number, pace=visit.pace)
        _keep(number, recording, found, table_file)
        _plan(number, session_id, chosen, set(chosen))
        return number

    try:
        number = ingest.in_transaction(insert, until=lambda: bool(ingest.with_sha256(sha256)))
    except DuplicateError:
        if not (known := ingest.with_sha256(sha256)):
            raise
        return _known(path, known, visit, about, chosen, named)
    said = f"subject {visit.subject}, session {visit.session_label}; {found.text()}"
    if found.unused:
        said += f"; not in the marker set: {', '.join(found.unused)}"
    return Ingested(path, "registered", number, said)


def _check_same_set(session_id: int, about: Mapping[str, Any], path: Path) -> None:
    """Raise `PblError` USAGE where the session has recordings with another marker set: one body is fitted to all."""
    there = video.MarkerRecording * video.Video.proj("session_id") & {"session_id": session_id}
    for row in there.proj(*about).to_dicts():
        if any(row[k] != v for k, v in about.items()):
            raise _usage(
                f"marker set {about['recording_marker_set']} in a session with another, or another table of that name",
                f"{row['recording_marker_set']}, as video_id {row['video_id']} of the session",
                path,
                "register it with that set, or in a session of its own",
            )


def _keep(video_id: int, recording: Mapping[str, Any], found: MarkerFile, table_file: Path | None) -> None:
    with new_folder() as folder:
        found.trial.save(folder / "markers.npz")
        files = {"markers_file": folder / "markers.npz", "marker_table_file": table_file}
        video.MarkerRecording.insert1({"video_id": video_id, **recording, **files})


def _plan(video_id: int, session_id: int, chosen: Mapping[str, str], named: set[str]) -> list[str]:
    """Insert the plans that these methods need and that are not there; returns what was added, in words."""
    rows = ingest.selections([], [session_id], dict(chosen), named - {"fit_method"})
    if "fit_method" in named:
        rows.append((fit.MarkerPlan, [{"video_id": video_id, "fit_method": chosen["fit_method"]}]))
    return ingest.insert_new(rows)


def _known(
    path: Path,
    row: dict[str, Any],
    visit: Visit,
    about: Mapping[str, Any],
    chosen: dict[str, str],
    named: Methods,
) -> Ingested:
    ingest.check_owner(row, visit.subject, visit.session_label, path)
    number = int(row["video_id"])
    recorded = (video.MarkerRecording & {"video_id": number}).to_dicts()
    if not recorded:
        raise _usage(
            f"bytes that are registered as a video, video_id {number}",
            "markers that are new, or registered as markers",
            path,
            f"delete video_id {number} from video.Video where it was registered by mistake",
        )
    if any(recorded[0][k] != v for k, v in about.items()):
        raise _usage(
            f"marker set {about['recording_marker_set']} for markers that are registered, video_id {number}",
            f"{recorded[0]['recording_marker_set']} as it was registered",
            path,
            f"delete video_id {number} from video.Video, then register it with the other set",
        )
    status, notes = "known", [f"already video_id {number} of subject {row['subject']}, session {row['session_label']}"]
    if str(path) != row["video_path"] and not Path(row["video_path"]).is_file():
        video.Video.update1({"video_id": number, "video_path": str(path), "video_name": path.name[-255:]})
        status = "moved"
    given = {k for k, field in ingest.METHOD_FIELDS.items() if getattr(named, field) is not None and k in chosen}
    changes = ingest.in_transaction(
        lambda: _plan(number, int(row["session_id"]), chosen, given) + set_condition(number, visit.activity, visit.pace)
    )
    changes += ingest.new_population(row["subject"], visit.population)
    changes += ingest.in_transaction(lambda: set_height(row["subject"], visit.height_m))
    if changes and status == "known":
        status = "updated"
    return Ingested(path, status, number, "; ".join(notes + (changes or ["nothing was inserted"])))


def _usage(found: str, expected: str, key: object = None, next_step: str = "see `pbl ingest --help`") -> PblError:
    return PblError("USAGE", found=found, expected=expected, next_step=next_step, key=key)
