"""The whole chain on files: videos of one session in, results and report out. The tables do the same row by row."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from pbl_pipeline import __version__
from pbl_pipeline.body import SCALE_NAMES
from pbl_pipeline.code_version import code_version
from pbl_pipeline.deidentify import to_show
from pbl_pipeline.errors import PblError
from pbl_pipeline.export import write_angles_csv
from pbl_pipeline.fit import METHODS as FIT_METHODS
from pbl_pipeline.fit import Params as FitParams
from pbl_pipeline.fit import SessionFit, TrialFit, check_trial, default_fit, fit_session
from pbl_pipeline.gait import DEFAULT_NORM, GaitMetrics, gait_metrics, load_norm
from pbl_pipeline.keypoints import METHODS as KEYPOINT_METHODS
from pbl_pipeline.keypoints import KeypointParams, Keypoints, check_keypoints, detect_keypoints
from pbl_pipeline.methods import Method
from pbl_pipeline.names import check_height, check_label, distinct
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.qc import WARN, Check
from pbl_pipeline.render import overlay_frames, render_overlay, report_indices
from pbl_pipeline.report import Picture, SessionReport, TrialReport, write_report
from pbl_pipeline.tracking import SubjectChoice, TrackingParams, choose_subject, require_subject, track_people
from pbl_pipeline.video import VideoInfo, attitude_of, check_timing, find_camera, probe, read_phone_log, sha256_of

#: What `write_results` writes for each trial, after the trial's name and a dot.
TRIAL_FILES = ("overlay.mp4", "angles.csv", "events.csv", "fit.npz", "keypoints.npz")


@dataclasses.dataclass(frozen=True)
class Trial:
    """One recording up to its keypoints. `shown`: the recording whose pictures overlay and report show, where that is
    another one (a de-identified copy); None: what `deidentify.to_show` says."""

    name: str
    path: Path
    video: VideoInfo
    choice: SubjectChoice
    keypoints: Keypoints
    shown: Path | None = None


@dataclasses.dataclass(frozen=True)
class Session:
    """A session: the trials that were fitted, in the order of the fit, and what became of the others: `problems` where
    this run met them, `left_out` (name to sentence) where the tables hold them."""

    trials: tuple[Trial, ...]
    fit: SessionFit
    metrics: GaitMetrics
    problems: Mapping[str, PblError] = dataclasses.field(default_factory=dict)
    left_out: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def checks(self) -> tuple[Check, ...]:
        """What was seen in each trial, and which recordings are missing."""
        found = [
            c
            for t in self.trials
            for c in _named([*check_timing(t.video), *check_keypoints(t.keypoints)], t.name, len(self.trials))
        ]
        missing = {n: e.text() for n, e in self.problems.items()} | dict(self.left_out)
        found += (Check(f"trial {n}", WARN, None, None, f"left out: {why}") for n, why in missing.items())
        return tuple(found)

    @property
    def judged(self) -> GaitMetrics:
        """The measures with every check of the session: what metrics.json, the terminal and the report judge by."""
        return self.metrics.with_checks([*self.checks, *self.fit.qc])


def fit_default(keypoints: Method[KeypointParams]) -> str:
    """Name of the fit's default method for the keypoints of that method (`fit.default_fit`).

    Raises `PblError` MODEL_MISSING, MODEL_INVALID for a model that is not registered here.
    """
    return default_fit(keypoints.params.points())


def detect_trial(
    path: Path,
    sheet: Path,
    camera_file: Path | None = None,
    person: int | None = None,
    keypoints: Method[KeypointParams] | None = None,
    people: Method[TrackingParams] | None = None,
) -> Trial:
    """Video to keypoints of the subject. `sheet` is the picture of the people that is written when one must be chosen.
    `keypoints` and `people` are the methods, None the default.

    Raises
    ------
    PblError
        The VIDEO_ codes, TRACK_NO_PERSON, TRACK_TOO_SHORT, SUBJECT_NEEDS_CHOICE, SUBJECT_UNKNOWN_PERSON, ASSET_ codes,
        CAMERA_INVALID, MODEL_ codes, DEVICE_UNAVAILABLE.
    """
    info = probe(path)
    camera = find_camera(info, camera_file)
    tracking = track_people(path, people, info=info)
    choice = choose_subject(tracking, override=person)
    subject = require_subject(choice, tracking, path, sheet)
    return Trial(path.stem, path, info, choice, detect_keypoints(path, tracking, subject, camera, params=keypoints))


def run_session(
    paths: Sequence[Path],
    out: Path,
    camera_file: Path | None = None,
    person: int | None = None,
    paramset: Method[FitParams] | Paramset | str | None = None,
    camera_motion: str | None = None,
    norm: str | None = None,
    attitude_files: Sequence[Path] = (),
    keypoints: Method[KeypointParams] | None = None,
    people: Method[TrackingParams] | None = None,
    height_m: float | None = None,
) -> Session:
    """Videos of one session to gait measures. A video that fails is left out with its problem, and so is one whose
    bytes were named before, because its steps would count twice; the others go on. Into `out` goes only a picture of
    the people of a video in which one must be chosen.

    `paramset` is the method of the fit; None: the one that suits the keypoints (`fit_default`). `attitude_files` holds
    a sensor log of the phone for each path, or nothing; one that does not belong to its video leaves that out.
    `camera_motion` None stands for "handheld" where there are logs, else "static". `height_m`: as in `fit_session`.

    Raises
    ------
    PblError
        The error of the video where no video of the session can be fitted; NORM_UNKNOWN, NORM_INVALID; FILE_MISSING,
        PHONE_LOG for a log that cannot be read.
    """
    # A wrong name or log must not cost a fit.
    method = FIT_METHODS.find(paramset or fit_default(KEYPOINT_METHODS.find(keypoints)))
    basis = load_norm(norm or DEFAULT_NORM)
    check_height(height_m)
    logs = [(file, read_phone_log(file)) for file in attitude_files] or [None] * len(paths)
    camera_motion = camera_motion or ("handheld" if attitude_files else "static")
    trials, problems, seen = [], {}, {}
    for path, name, log in zip(paths, distinct_names(paths), logs, strict=True):
        try:
            first = seen.setdefault(sha256_of(path), name)
            if first != name:
                raise _named_twice(path, first)
            trial = dataclasses.replace(
                detect_trial(path, out / f"{name}.persons.png", camera_file, person, keypoints, people), name=name
            )
            if log is not None:
                attitude = attitude_of(log[1], log[0], trial.video)
                trial = dataclasses.replace(trial, keypoints=trial.keypoints.with_attitude(attitude))
            check_trial(trial.keypoints, name, method)
        except PblError as error:
            problems[name] = error
        else:
            trials.append(trial)
    if not trials:
        raise next(iter(problems.values()))
    fit = fit_session([t.keypoints for t in trials], [t.name for t in trials], method, camera_motion, height_m=height_m)
    return Session(tuple(trials), fit, gait_metrics(fit.trials, norm=basis, fit_checks=fit.qc), problems)


def write_results(
    out: Path,
    session: Session,
    title: str = "Gait report",
    subject_code: str = "-",
    date: str = "",
    origin: Mapping[str, Mapping[str, str]] | None = None,
) -> list[Path]:
    """Write everything a person or program reads of a session into `out` and return the paths, the report first.

    `<name>.keypoints.npz`, `.fit.npz`, `.angles.csv`, `.events.csv` and `.overlay.mp4` per trial; `session.json`,
    `metrics.json` and `report.html` (docs/files.md). Where PBL_DEIDENTIFY says so, overlays and pictures show the
    recordings with hidden heads.

    Raises the `PblError`s of `render_overlay` and `deidentify.to_show`.
    """
    out.mkdir(parents=True, exist_ok=True)
    with _as_shown(session) as shown:
        return _write_results(out, shown, title, subject_code, date, origin)


def write_session_report(
    path: Path,
    session: Session,
    title: str = "Gait report",
    subject_code: str = "-",
    date: str = "",
    origin: Mapping[str, Mapping[str, str]] | None = None,
) -> Path:
    """Write `report.html` of a session alone, as `write_results` does, and return its path.

    Raises the `PblError`s of `overlay_frames` and `deidentify.to_show`.
    """
    with _as_shown(session) as shown:
        return _write_report(path, shown, title, subject_code, date, origin)


@contextlib.contextmanager
def _as_shown(session: Session) -> Iterator[Session]:
    """The session with the recordings whose pictures may be shown."""
    with tempfile.TemporaryDirectory() as folder:
        trials = tuple(
            dataclasses.replace(t, shown=t.shown or to_show(t.path, Path(folder), t.video)) for t in session.trials
        )
        yield dataclasses.replace(session, trials=trials)


def _write_results(
    out: Path,
    session: Session,
    title: str,
    subject_code: str,
    date: str,
    origin: Mapping[str, Mapping[str, str]] | None,
) -> list[Path]:
    paths = [out / "report.html"]
    for trial, fit, measured in zip(session.trials, session.fit.trials, session.metrics.trials, strict=True):
        files = {end: out / f"{trial.name}.{end}" for end in TRIAL_FILES}
        events = measured.events.events if measured.events else ()
        render_overlay(
            trial.shown or trial.path,
            fit,
            files["overlay.mp4"],
            keypoints=trial.keypoints,
            events=events,
        )
        write_angles_csv(fit, files["angles.csv"])
        if measured.events:
            measured.events.save(files["events.csv"])
        fit.save(files["fit.npz"])
        trial.keypoints.save(files["keypoints.npz"])
        paths += [p for p in files.values() if p.exists()]
    write_session_json(session.fit, out / "session.json")
    session.judged.save(out / "metrics.json")
    _write_report(out / "report.html", session, title, subject_code, date, origin)
    return [*paths, out / "session.json", out / "metrics.json"]


def _write_report(
    path: Path,
    session: Session,
    title: str,
    subject_code: str,
    date: str,
    origin: Mapping[str, Mapping[str, str]] | None,
) -> Path:
    reports = tuple(
        TrialReport(t.name, t.video, t.choice, fit, t.keypoints, _pictures(t, fit))
        for t, fit in zip(session.trials, session.fit.trials, strict=True)
    )
    report = SessionReport(
        title=title,
        subject_code=subject_code,
        date=date,
        trials=reports,
        metrics=session.judged,
        session=session.fit,
        checks=session.checks,
        origin=dict(origin or {}) | {"Software": {"pbl-pipeline": __version__} | _models(session)},
    )
    write_report(path, report)
    return path


def _models(session: Session) -> dict[str, str]:
    """Which model made the keypoints of each trial, under which licence; nothing where none says."""
    made = {t.name: t.keypoints.origin for t in session.trials if t.keypoints.origin}
    return {f"keypoints of {name}": origin for name, origin in made.items()}


def write_session_json(fit: SessionFit, path: Path) -> None:
    """Write `session.json`: how the session was fitted and how well."""
    content = {
        "trials": [t.name for t in fit.trials],
        "orientation_source": {t.name: t.orientation_source for t in fit.trials},
        "phone_clock_offset_s": {t.name: _known(t.phone_clock_offset_s) for t in fit.trials},
        "solver": fit.solver,
        "params_hash": fit.params_hash,
        "iterations": int(fit.iterations),
        "converged": bool(fit.converged),
        "height_m": _known(fit.trials[0].height_m),
        "scale": dict(zip(SCALE_NAMES, (round(float(s), 5) for s in fit.scale), strict=True)),
        "loss_trace": [[int(step), round(float(loss), 5)] for step, loss in fit.loss_trace],
        "seconds": round(fit.seconds, 3),
        "compile_seconds": round(fit.compile_seconds, 3),
        "device": fit.device,
        "qc": [c.to_dict() for c in fit.qc],
        "code_version": code_version(),
    }
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _known(value: float) -> float | None:
    """The number for JSON; None where it is NaN."""
    return round(float(value), 4) if math.isfinite(value) else None


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """A name for each path: its stem, numbered where stems repeat. Raises `PblError` USAGE for control characters."""
    for path in paths:
        check_label("file name", path.stem, 255, least=1)
    return distinct([p.stem for p in paths], range(1, len(paths) + 1))


def _named_twice(path: Path, first: str) -> PblError:
    return PblError(
        "USAGE",
        found=f"the same bytes as {first}",
        expected="every recording once",
        next_step="name it once; if these should be two recordings, copy them from the phone again",
        key=path,
    )


def _named(checks: Sequence[Check], trial: str, n_trials: int) -> list[Check]:
    """The checks, with the trial's name where there are several."""
    if n_trials == 1:
        return list(checks)
    return [dataclasses.replace(c, check=f"{c.check} ({trial})") for c in checks]


def _pictures(trial: Trial, fit: TrialFit) -> tuple[Picture, ...]:
    """Frames for the report, cut to the person."""
    index = report_indices(fit)
    images = overlay_frames(trial.shown or trial.path, fit, index, crop_to_body=True, max_side_px=760)
    return tuple(Picture(i, float(fit.time_s[i]), image) for i, image in zip(index, images, strict=True))
