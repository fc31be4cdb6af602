"""Files of a visit in a folder; no other module knows their names (docs/files.md)."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.body import SCALE_NAMES, MarkerSet
from pbl_pipeline.bounded import read_json
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import load_npz
from pbl_pipeline.filming import SINGLE
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.fit.angles_file import write_angles_csv
from pbl_pipeline.gait import Condition, GaitEvent, TrialMetrics, load_events
from pbl_pipeline.gait.metrics_file import Curves, checks_of, load_curves, metrics_of, save_curves
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.kinetics import Kinetics
from pbl_pipeline.kinetics.kinetics_file import kinetics_of, load_arrays, save_arrays, save_content
from pbl_pipeline.names import distinct
from pbl_pipeline.qc import WARN, Check
from pbl_pipeline.records import from_json, plain
from pbl_pipeline.results import Solution, SubjectChoice
from pbl_pipeline.video import VideoInfo

from .types import Held, Recording, Visit

#: Files of a visit. `overlay.mp4` and `report.html` are drawn by `pipeline.write_results`.
SESSION, METRICS, REPORT, KINETICS = "session.json", "metrics.json", "report.html", "kinetics.json"
#: Files of a recording, after its name and a dot.
KEYPOINTS, FIT, ANGLES, EVENTS, CYCLES, FORCES, OVERLAY = (
    "keypoints.npz",
    "fit.npz",
    "angles.csv",
    "events.csv",
    "cycles.npz",
    "kinetics.npz",
    "overlay.mp4",
)
_AGAIN = "`pbl run` again"
_MEASURE = f"`pbl gait *.fit.npz --out {METRICS}` in its folder writes it"


def save_visit(visit: Visit, folder: Path) -> list[Path]:
    """Write the visit into a folder and return the paths (docs/files.md).

    For each fitted recording `<name>.keypoints.npz`, `.fit.npz`, `.angles.csv`, `.events.csv`, `.cycles.npz`; for
    the visit `metrics.json` and, last, `session.json`; with kinetics also `kinetics.json` and `<name>.kinetics.npz`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for recording in visit.fitted:
        paths += _save_recording(recording, folder)
    if (judged := visit.judged) is not None:
        judged.save(folder / METRICS)
        paths.append(folder / METRICS)
    if visit.kinetics is not None:
        paths += save_kinetics(visit.kinetics, folder)
    (folder / SESSION).write_text(json.dumps(visit_facts(visit), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return [*paths, folder / SESSION]


def save_kinetics(kinetics: Kinetics, folder: Path) -> list[Path]:
    """Write `<name>.kinetics.npz` of each trial that has forces, then `kinetics.json`, and return the paths."""
    paths = []
    for trial in kinetics.trials:
        if trial.series is not None:
            paths.append(_file(folder, trial.name, FORCES))
            save_arrays(trial, paths[-1])
    save_content(kinetics, folder / KINETICS)
    return [*paths, folder / KINETICS]


def visit_facts(visit: Visit) -> dict[str, Any]:
    """Return the content of session.json."""
    fits = {r.name: r.fit for r in visit.fitted if r.fit is not None}
    content: dict[str, Any] = {
        "trials": list(fits),
        "orientation_source": {n: f.orientation_source for n, f in fits.items()},
        "phone_clock_offset_s": {n: plain(round(f.phone_clock_offset_s, 4)) for n, f in fits.items()},
        "sensors": {n: plain(f.sensors, 6) for n, f in fits.items() if f.sensors},
        "depths": {n: plain(f.depth, 6) for n, f in fits.items() if f.depth is not None},
        "height_m": next((plain(round(f.height_m, 4)) for f in fits.values()), None),
        "qc": plain(visit.fit_checks),
    }
    if visit.solution is not None:
        s = visit.solution
        own = plain(s, 5)
        del own["software"]
        content |= {
            **own,
            "scale": dict(zip(SCALE_NAMES, own["scale"], strict=True)),
            "loss_trace": [[int(step), loss] for step, loss in own["loss_trace"]],
            "seconds": round(s.seconds, 3),
            "compile_seconds": round(s.compile_seconds, 3),
            "code_version": s.software,
        }
    whose = {"subject": visit.subject, "label": visit.label, "date": visit.date, "kind": visit.kind}
    return {
        **content,
        "visit": {
            **whose,
            "methods": dict(visit.methods),
            "recordings": [recording_facts(r) for r in visit.recordings],
        },
    }


def load_visit(folder: Path, *, measures: bool = True) -> Visit:
    """Read a visit written by `save_visit`. Arrays are loaded on access; `lacks` names missing files.

    `measures`: also read metrics.json. A folder without session.json, which is written last, is that of an interrupted
    run: its fits are read. Raises `PblError` FILE_MISSING if there are no fits either, FILE_FORMAT for content that
    `save_visit` did not write.
    """
    path = folder / SESSION
    found = [] if path.is_file() else [name_of_fit(fit) for fit in sorted(folder.glob(f"*.{FIT}"))]
    content = {"trials": found, "qc": []} if found else _read(path)
    with file_of_visit(path):
        names, told = [str(n) for n in content["trials"]], content.get("visit", {})
        facts = {str(r["name"]): r for r in told.get("recordings", ())}
        fits = [folder / f"{name}.{FIT}" for name in names]
        wanted = [*fits, *(_file(folder, n, KEYPOINTS) for n in names if facts.get(n, {}).get("video"))]
        old = () if "visit" in content else (f"facts of the videos, the subject and the methods: {_AGAIN}",)
        ended = (f"no {SESSION}: {_AGAIN}",) if found else ()
        visit = Visit(
            recordings=(
                *(_recording(fit, facts.get(n, {})) for n, fit in zip(names, fits, strict=True) if fit.is_file()),
                *(Recording(n, **_told(r, None)) for n, r in facts.items() if n not in names),
            ),
            solution=_solution(content) if "solver" in content else None,
            fit_checks=(_checks_unknown(names),) if found and not (folder / METRICS).is_file() else checks_of(content),
            subject=str(told.get("subject", "-")),
            label=str(told.get("label", "")),
            date=str(told.get("date", "")),
            kind=str(told.get("kind", SINGLE)),
            methods={str(k): str(v) for k, v in told.get("methods", {}).items()},
            lacks=(*(ended or old), *(f"no {p.name}: {_AGAIN}" for p in wanted if not p.is_file())),
        )
    return _with_stored_measures(visit, folder) if measures else visit


def visit_of_fits(paths: Sequence[Path], *, markers: MarkerSet | None = None, measures: bool = True) -> Visit:
    """Return the visit of these fit.npz files, loaded, with the other files in their folders that belong to them.

    With several folders, or some of a folder's fits, each recording has its own measures, but there are none over all
    of them; with several folders the facts of the visit are also unknown. `markers`: the lab's own marker table of
    these fits. Raises as `load_visit`, and as `TrialFit.load`.
    """
    folders = {p.parent: None for p in paths}
    known = {f: load_visit(f, measures=measures) for f in folders if (f / SESSION).is_file()}
    stems = [name_of_fit(p) for p in paths]
    recordings, checks, unknown = [], [], []
    for path, stem, name in zip(paths, stems, distinct(stems, range(1, len(stems) + 1)), strict=True):
        fit, visit = TrialFit.load(path), known.get(path.parent)
        own = (
            None
            if visit is None or visit.solution is None or visit.solution.params_hash != fit.params_hash
            else next((r for r in visit.fitted if r.name == stem), None)
        )
        if own is None or visit is None:
            unknown.append(fit.name)
            own = _recording(path, {})
        else:
            checks += visit.fit_checks
        recordings.append(dataclasses.replace(own, name=name, markers=markers, load_fit=Held(fit)))
    if unknown:
        checks.append(_checks_unknown(unknown))
    visit = next(iter(known.values()), None)
    if visit is None or unknown or len(folders) > 1:
        return Visit(tuple(recordings), fit_checks=tuple(dict.fromkeys(checks)))
    if stems == [r.name for r in visit.fitted]:
        return dataclasses.replace(visit, recordings=(*recordings, *visit.left_out))
    return dataclasses.replace(visit, recordings=tuple(recordings), measures=None)


# ------------------------------------------------------------------------------------------------------------- writing
def _save_recording(recording: Recording, folder: Path) -> list[Path]:
    fit, points, measured = recording.fit, recording.keypoints, recording.measured
    assert fit is not None
    fit.save(_file(folder, recording.name, FIT))
    write_angles_csv(fit, _file(folder, recording.name, ANGLES))
    written = [FIT, ANGLES]
    if points is not None:
        points.save(_file(folder, recording.name, KEYPOINTS))
        written.append(KEYPOINTS)
    if measured is not None:
        written += _save_measured(measured, folder, recording.name)
    return [_file(folder, recording.name, end) for end in (KEYPOINTS, FIT, ANGLES, EVENTS, CYCLES) if end in written]


def save_beside(measured: Sequence[TrialMetrics], fits: Sequence[Path], metrics: Path) -> None:
    """Write the events and cycles of those fits that are in the folder of a metrics.json."""
    for trial, path in zip(measured, fits, strict=True):
        if path.name == f"{trial.name}.{FIT}" and path.resolve().parent == metrics.resolve().parent:
            _save_measured(trial, metrics.parent, trial.name)


def _save_measured(measured: TrialMetrics, folder: Path, name: str) -> list[str]:
    measured.events.save(_file(folder, name, EVENTS))
    save_curves(measured.cycles, _file(folder, name, CYCLES))
    return [EVENTS, CYCLES]


def name_of_fit(path: Path) -> str:
    """Return the name of the recording whose fit is in this file."""
    return path.name.removesuffix(".npz").removesuffix(".fit")


def _file(folder: Path, name: str, end: str) -> Path:
    return folder / f"{name}.{end}"


def recording_facts(recording: Recording) -> dict[str, Any]:
    """Return the content of session.json about a recording: facts without arrays, and only the name of its file."""
    video, choice = recording.video, recording.choice
    facts: dict[str, Any] = {"name": recording.name, "problem": recording.problem, "video": None}
    facts["choice"] = None if choice is None else dataclasses.asdict(choice)
    facts["condition"] = dataclasses.asdict(recording.condition)
    if video is not None:
        own = {k: v for k, v in vars(video).items() if k not in ("time_s", "path")}
        facts["video"] = {**own, "file": Path(video.path).name}
    return plain(facts)


# ------------------------------------------------------------------------------------------------------------- reading
@contextlib.contextmanager
def file_of_visit(path: Path, again: str = _AGAIN) -> Iterator[None]:
    """Turn errors of reading a file of a visit into `PblError` FILE_FORMAT. `again`: how to write the file again."""
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise PblError(
            "FILE_FORMAT",
            found=f"{type(error).__name__}: {error}",
            expected=f"the {path.name} that `pbl run` or `pbl fit` wrote with the other files of its folder",
            next_step=f"{again}; or move the file away: then its content is not known",
            key=str(path),
        ) from error


def _read(path: Path, again: str = _AGAIN) -> dict[str, Any]:
    """Return the object in a JSON file without NaN. Raises `PblError` FILE_MISSING, FILE_FORMAT."""
    if not path.is_file():
        raise PblError(
            "FILE_MISSING",
            found=f"no {path.name}",
            expected="the files of `pbl run` as it wrote them",
            next_step=again,
            key=str(path),
        )
    with file_of_visit(path, again):
        content = read_json(path)
        if not isinstance(content, dict):
            raise TypeError("not a JSON object")
        json.dumps(content, allow_nan=False)  # raises ValueError for NaN and infinity, which no file of ours holds
        return content


def _recording(fit: Path, facts: Mapping[str, Any]) -> Recording:
    """Return a fitted recording from its files and its `facts` in session.json."""
    name = name_of_fit(fit)
    points = fit.with_name(f"{name}.{KEYPOINTS}")
    return Recording(
        name,
        **_told(facts, points),
        load_keypoints=functools.partial(_keypoints_of, points, fit),
        load_fit=functools.partial(TrialFit.load, fit),
    )


def _told(facts: Mapping[str, Any], points: Path | None) -> dict[str, Any]:
    """Return the fields of a recording from its facts in session.json; `points`: file of its keypoints."""
    video, choice = facts.get("video"), facts.get("choice")
    return {
        "video": None if video is None else _video(video, points),
        "choice": None if choice is None else from_json(SubjectChoice, choice),
        "condition": Condition(**facts.get("condition", {})),
        "problem": str(facts.get("problem", "")),
    }


def _video(facts: Mapping[str, Any], points: Path | None) -> VideoInfo:
    """Return the facts of a video. Its time stamps are those of its keypoints, NaN without them."""
    own = dict(facts)
    file, n = str(own.pop("file")), int(own["n_frames"])
    time = None if points is None or not points.is_file() else load_npz(points, ["time_s"]).get("time_s")
    if time is None or np.shape(time) != (n,):
        time = np.full(n, np.nan)
    return from_json(VideoInfo, own, path=file, time_s=time)


def _keypoints_of(path: Path, fit_path: Path) -> Keypoints | None:
    """Return the keypoints of a fit; None if there is no such file or it is of another recording."""
    if not path.is_file():
        return None
    found, fit = Keypoints.load(path), TrialFit.load(fit_path)
    same = np.shape(found.time_s) == np.shape(fit.time_s) and np.allclose(found.time_s, fit.time_s, atol=1e-3)
    return found if same else None


def _solution(content: Mapping[str, Any]) -> Solution:
    own = {f.name: content.get(f.name) for f in dataclasses.fields(Solution)}
    own["scale"] = [content["scale"][n] for n in SCALE_NAMES]
    own["loss_trace"] = np.reshape(content["loss_trace"], (-1, 2))
    return from_json(Solution, own, software=content.get("code_version", ""))


def _checks_unknown(names: Sequence[str]) -> Check:
    advice = (
        f"no session.json of {', '.join(names)} lies beside the fit: whether the body lies on the person is not known; "
        "look at what `pbl fit` printed"
    )
    return Check("fit_checks_known", WARN, float(len(names)), 0.0, advice)


def _with_stored_measures(visit: Visit, folder: Path) -> Visit:
    """Return the visit with the measures of its metrics.json, and their missing files in `lacks`."""
    path, lacks = folder / METRICS, list(visit.lacks)
    if not path.is_file():
        return dataclasses.replace(visit, lacks=(*lacks, f"no {METRICS}: {_MEASURE}"))
    events: dict[str, Sequence[GaitEvent]] = {}
    curves: dict[str, Mapping[int, Curves]] = {}
    for recording in visit.fitted:
        for end in (EVENTS, CYCLES):
            file = _file(folder, recording.name, end)
            if not file.is_file():
                lacks.append(f"no {file.name}: {_MEASURE}")
            elif end == EVENTS:
                events[recording.name] = load_events(file)
            else:
                curves[recording.name] = load_curves(file)
    content = _read(path, _MEASURE)
    with file_of_visit(path, _MEASURE):
        measures = metrics_of(content, events, curves)
        by_name = {t.name: t for t in measures.trials}
        if not set(by_name) >= {r.name for r in visit.fitted}:
            raise ValueError(f"measures of {', '.join(by_name) or 'no trial'}")
        if other := [c.check for c in visit.fit_checks if c not in measures.before]:
            raise ValueError(f"measures of another fit, whose check {other[0]} is not the same")
    measures = dataclasses.replace(measures, trials=tuple(by_name[r.name] for r in visit.fitted))
    visit = dataclasses.replace(visit.with_measures(measures), lacks=tuple(lacks))
    return dataclasses.replace(visit, kinetics=load_kinetics(folder, [r.name for r in visit.fitted]))


def load_kinetics(folder: Path, names: Sequence[str]) -> Kinetics | None:
    """Return the kinetics of the fitted recordings `names`; None if the folder has none (files of version 0.2).

    Raises `PblError` FILE_FORMAT if they are those of other recordings.
    """
    if not (folder / KINETICS).is_file():
        return None
    files = {name: _file(folder, name, FORCES) for name in names}
    content = _read(folder / KINETICS, _MEASURE)
    with file_of_visit(folder / KINETICS, _MEASURE):
        found = kinetics_of(content, {n: load_arrays(f) for n, f in files.items() if f.is_file()})
        by_name = {t.name: t for t in found.trials}
        if not set(by_name) >= set(names):
            raise ValueError(f"kinetics of {', '.join(by_name) or 'no trial'}")
    return dataclasses.replace(found, trials=tuple(by_name[n] for n in names))
