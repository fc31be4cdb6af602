"""A visit from the tables as `pbl_pipeline.export` takes it; nothing is computed anew."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from . import fit, video
from .report import methods_of
from .results import FittedTrial, load_session, not_finished
from .stored_files import file_ref, stored_file

if TYPE_CHECKING:
    from pbl_pipeline.export import ExportSession, ExportTrial
    from pbl_pipeline.gait import TrialMetrics


def session_of_tables(restriction: Any, *, sensors: bool = True) -> ExportSession:
    """The fitted trials of one session with their events, cycles and measures; with `sensors`, the phones' logs.

    Raises
    ------
    PblError
        DB_NOT_FOUND when the session is unknown or not fitted yet, USAGE when several match, PHONE_LOG for a stored log
        that is not the one the keypoints were made with.
    """
    from pbl_pipeline.export import ExportSession

    found = load_session(restriction)
    if found.fit is None:
        raise not_finished(found, "fit")
    methods = methods_of(found.key)
    version = (fit.SessionFit & found.key).fetch1("fit_code_version")
    measured = found.metrics.trials if found.metrics is not None else (None,) * len(found.fitted)
    trials = tuple(
        _trial(trial, of_trial, methods, version, sensors)
        for trial, of_trial in zip(found.fitted, measured, strict=True)
    )
    return ExportSession(trials, found.metrics, found.fit.qc)


def _trial(
    trial: FittedTrial, measured: TrialMetrics | None, methods: dict[str, str], version: str, sensors: bool
) -> ExportTrial:
    from pbl_pipeline.export import ExportTrial, log_shift_s
    from pbl_pipeline.video import read_phone_log

    log, shift = None, 0.0
    rows = (video.PhoneAttitude & {"video_id": trial.video_id}).to_dicts() if sensors else []
    if rows:
        with stored_file(video.PhoneAttitude(), file_ref(rows[0]["attitude_file"])) as path:
            log = read_phone_log(path)
        shift = log_shift_s(log, trial.keypoints, f"video {trial.video_id}")
    return ExportTrial(
        name=trial.name,
        fit=trial.fit,
        keypoints=trial.keypoints,
        measured=measured,
        log=log,
        log_shift_s=shift,
        methods=methods,
        fitted_with=version,
    )
