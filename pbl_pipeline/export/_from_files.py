"""A visit to export from the files of `pbl fit` or `pbl run`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline.body import MarkerSet
from pbl_pipeline.bounded import read_json
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import gait_metrics
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.names import distinct
from pbl_pipeline.qc import Check
from pbl_pipeline.video import VIDEO_CLOCK, PhoneLog, read_phone_log

from ._trial import ExportTrial
from ._write import ExportSession


def session_of_files(
    paths: Sequence[Path],
    *,
    attitude: Sequence[Path] = (),
    markers: MarkerSet | None = None,
    gait: bool = True,
    fit_checks: Sequence[Check] = (),
) -> ExportSession:
    """The fits of one visit with the keypoints beside them (`walk.keypoints.npz` of `walk.fit.npz`) and, with `gait`,
    their events, cycles and measures as `pbl gait` computes them.

    attitude: a sensor log of the phone for each path, or nothing. markers: a table of one's own for all of them.

    Raises
    ------
    PblError
        FILE_MISSING, FILE_FORMAT, CAMERA_INVALID of the files; USAGE for another number of logs; PHONE_LOG for one that
        cannot be read or whose clock is not known without keypoints that have it; GAIT_INPUT as `gait_metrics`.
    """
    if attitude and len(attitude) != len(paths):
        raise PblError(
            "USAGE",
            found=f"{len(attitude)} times --attitude for {len(paths)} fits",
            expected="none, or one for each fit, in the same order",
            next_step="name a log for each fit",
        )
    fits = [TrialFit.load(path) for path in paths]
    stems = [path.name.removesuffix(".npz").removesuffix(".fit") for path in paths]
    metrics = gait_metrics(fits, fit_checks=fit_checks) if gait else None
    trials = []
    for i, (path, fit, name) in enumerate(zip(paths, fits, distinct(stems, range(1, len(stems) + 1)), strict=True)):
        keypoints = _keypoints(path.with_name(f"{stems[i]}.keypoints.npz"), fit)
        log = read_phone_log(attitude[i]) if attitude else None
        trials.append(
            ExportTrial(
                name=name,
                fit=fit,
                markers=markers,
                keypoints=keypoints,
                measured=metrics.trials[i] if metrics is not None else None,
                log=log,
                log_shift_s=0.0 if log is None else log_shift_s(log, keypoints, str(attitude[i])),
                fitted_with=_fitted_with(path.with_name("session.json"), fit),
            )
        )
    return ExportSession(tuple(trials), metrics, tuple(fit_checks))


def log_shift_s(log: PhoneLog, keypoints: Keypoints | None, path: str) -> float:
    """What added to the log's times gives the video's: known where the keypoints hold the log, brought to the video's
    clock when they were made, or where the log counts on it.

    Raises `PblError` PHONE_LOG.
    """
    stamps = None if keypoints is None else keypoints.phone_time_s
    if stamps is not None and len(stamps) == len(log.time_s):
        shift = stamps - log.time_s
        if np.ptp(shift) < 1e-3:
            return float(np.median(shift))
    if log.clock == VIDEO_CLOCK and stamps is None:
        return 0.0
    raise PblError(
        "PHONE_LOG",
        found="a log whose clock against the video's is not known",
        expected="the log that the keypoints beside the fit were made with (--attitude of `pbl detect`), or one on the "
        "video's clock",
        next_step="pass that log, or leave --attitude out",
        key=path,
    )


def _fitted_with(path: Path, fit: TrialFit) -> str:
    """The software that the session.json beside a fit names; empty where there is none of this fit."""
    try:
        content = read_json(path)
        return str(content["code_version"]) if content["params_hash"] == fit.params_hash else ""
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def _keypoints(path: Path, fit: TrialFit) -> Keypoints | None:
    """The keypoints of a fit; None where there is no such file or it is of another recording."""
    if not path.is_file():
        return None
    found = Keypoints.load(path)
    same = np.shape(found.time_s) == np.shape(fit.time_s) and np.allclose(found.time_s, fit.time_s, atol=1e-3)
    return found if same else None
