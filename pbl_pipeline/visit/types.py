"""Types of a visit and its recordings, which the chain computes and all consumers read."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from pbl_pipeline.body import MarkerSet
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.filming import SINGLE, Filming, height_word, known, picture_class, views_of
from pbl_pipeline.fit import SessionFit, TrialFit
from pbl_pipeline.gait import Condition, GaitCycle, GaitEvents, GaitMetrics, TrialMetrics, far_leg_of
from pbl_pipeline.keypoints import Keypoints, check_keypoints, log_shift_s
from pbl_pipeline.kinetics import Kinetics
from pbl_pipeline.qc import WARN, Check
from pbl_pipeline.results import Solution
from pbl_pipeline.tracking import SubjectChoice
from pbl_pipeline.video import PhoneLog, VideoInfo, check_timing, read_phone_log

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Held(Generic[T]):
    """A value in memory, as the function of a `Recording` that loads it."""

    value: T

    def __call__(self) -> T:
        return self.value


@dataclasses.dataclass(frozen=True)
class Recording:
    """One recording of a visit. Results of stages that did not run are None; `problem` explains a missing fit."""

    name: str  # of its files: the video's name without its ending, distinct within the visit
    path: Path | None = None  # the video; None if it is not known (results alone, markers of a laboratory)
    video: VideoInfo | None = None  # facts of the video
    choice: SubjectChoice | None = None  # of the person who is measured
    condition: Condition = dataclasses.field(default_factory=Condition)  # activity and pace
    events: GaitEvents | None = None  # those of `measured`, if any
    cycles: tuple[GaitCycle, ...] = ()  # likewise
    measured: TrialMetrics | None = None  # events, cycles, measures and index
    problem: str = ""  # reason for a missing fit, in a sentence
    shown: Path | None = None  # the recording whose pictures may be shown: `path`, or a copy with hidden heads
    markers: MarkerSet | None = None  # the lab's own marker table of the fit
    number: int | None = None  # in the tables the `video_id`
    load_keypoints: Callable[[], Keypoints | None] | None = None  # loads `keypoints`; None without them
    load_fit: Callable[[], TrialFit] | None = None  # loads `fit`; None without one
    load_log: Callable[[], tuple[PhoneLog, float] | None] | None = None  # loads `log`; None without one

    @classmethod
    def of(cls, name: str, fit: TrialFit | None = None, keypoints: Keypoints | None = None, **fields: Any) -> Recording:
        """Return a recording whose arrays are in memory."""
        held = None if fit is None else Held(fit)
        return cls(name, load_fit=held, load_keypoints=None if keypoints is None else Held(keypoints), **fields)

    def with_measured(self, measured: TrialMetrics) -> Recording:
        """Return the recording with its gait."""
        return dataclasses.replace(self, events=measured.events, cycles=measured.cycles, measured=measured)

    @property
    def fitted(self) -> bool:
        return self.load_fit is not None

    @functools.cached_property
    def fit(self) -> TrialFit | None:
        """The fitted movement. Raises `PblError` FILE_MISSING, FILE_FORMAT for a file that cannot be read."""
        return None if self.load_fit is None else self.load_fit()

    @functools.cached_property
    def keypoints(self) -> Keypoints | None:
        """Keypoints that the body was fitted to; None for markers of a laboratory. Raises as `fit`."""
        return None if self.load_keypoints is None else self.load_keypoints()

    @functools.cached_property
    def log(self) -> tuple[PhoneLog, float] | None:
        """The phone's sensor log and the shift from its times to the video's (s). Raises `PblError` PHONE_LOG."""
        return None if self.load_log is None else self.load_log()

    def loaded(self) -> Recording:
        """Return the recording with its fit and keypoints in memory, for another process or thread."""
        return dataclasses.replace(
            self,
            load_fit=None if self.fit is None else Held(self.fit),
            load_keypoints=None if self.keypoints is None else Held(self.keypoints),
            load_log=None,
        )

    @property
    def checks(self) -> tuple[Check, ...]:
        """Checks of the video's time stamps and of the keypoints."""
        timing = () if self.video is None else check_timing(self.video)
        return (*timing, *(() if self.keypoints is None else check_keypoints(self.keypoints)))


def solution_of(fit: SessionFit) -> Solution:
    """Return the solution of a fit that this code made."""
    own: dict[str, Any] = {f.name: getattr(fit, f.name) for f in dataclasses.fields(Solution)}
    return Solution(**{**own, "software": code_version()})


@dataclasses.dataclass(frozen=True)
class Visit:
    """A visit: person, date, methods and results."""

    recordings: tuple[Recording, ...]  # in the order of the fit, those without a fit after them
    solution: Solution | None = None  # of the fit; None if the chain ended before
    fit_checks: tuple[Check, ...] = ()  # quality of the fit
    measures: GaitMetrics | None = None  # its trials are the fitted recordings in their order
    subject: str = "-"  # code of the person, never a name
    label: str = ""  # of the visit
    date: str = ""  # of the visit, YYYY-MM-DD; empty where unknown
    kind: str = SINGLE  # of `filming.KINDS`
    #: Name of a stage up to the fit to the method that computed it, in words; those of the gait are in `measures`.
    methods: Mapping[str, str] = dataclasses.field(default_factory=dict)
    #: Missing files and facts, in sentences: of an older version, or of an interrupted run.
    lacks: tuple[str, ...] = ()
    #: Forces and joint moments of the fitted recordings, None if they were not computed.
    kinetics: Kinetics | None = None
    key: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # in the tables the primary key of its result

    @property
    def fitted(self) -> tuple[Recording, ...]:
        """The recordings with a fit, in its order."""
        return tuple(r for r in self.recordings if r.fitted)

    @property
    def left_out(self) -> tuple[Recording, ...]:
        return tuple(r for r in self.recordings if not r.fitted)

    @property
    def checks(self) -> tuple[Check, ...]:
        """Checks before the gait measures: of each recording, of those left out, of the fit."""
        if self.measures is not None and self.measures.before:
            return self.measures.before
        return (*stage_checks(self.recordings), *self.fit_checks)

    @property
    def height_m(self) -> float | None:
        """Stated body height (m), None if none was stated. Raises as `Recording.fit`."""
        stated = (r.fit.height_m for r in self.fitted if r.fit is not None)
        return next((float(h) for h in stated if np.isfinite(h)), None)

    def loaded(self) -> Visit:
        """Return the visit with the arrays of its recordings in memory."""
        return dataclasses.replace(self, recordings=tuple(r.loaded() for r in self.recordings))

    @property
    def judged(self) -> GaitMetrics | None:
        """The measures, judged by all checks of the visit, as in metrics.json, terminal and report."""
        if self.measures is None or self.measures.before:
            return self.measures
        return self.measures.with_checks(self.checks)

    @property
    def filming(self) -> Filming:
        """Filming conditions of the pooled recordings with a cycle that counts; aid and orthosis are only stated in
        tables. Loads the fits and raises as `Recording.fit`."""
        measured = [r for r in self.fitted if r.measured is not None and r.measured.pooled]
        pooled = [r for r in measured if any(c.used for c in r.cycles)]
        fits = [r.fit for r in pooled if r.fit is not None]
        one_camera = self.kind == SINGLE
        return Filming(
            views=views_of((r.name, c.far_leg) for r in pooled for c in r.cycles if c.used) if one_camera else (),
            paces=known(r.condition.pool for r in pooled),
            height=known(height_word(f.height_m, f.with_depths) for f in fits),
            cameras=known(f.camera.kind for f in fits) if one_camera else (),
            pictures=known(picture_class(*f.image_size_px) for f in fits) if one_camera else (),
            far_leg=far_leg_of([c for r in pooled for c in r.cycles]),
        )

    @property
    def title(self) -> str:
        """Subject and label, for lists."""
        return " ".join(t for t in (self.subject if self.subject != "-" else "", self.label or self.date) if t)

    def with_measures(self, measures: GaitMetrics) -> Visit:
        """Return the visit with these measures.

        Raises `PblError` FILE_FORMAT if they are not of the fitted recordings in their order.
        """
        fitted = [r.name for r in self.fitted]
        if [t.name for t in measures.trials] != fitted:
            raise PblError(
                "FILE_FORMAT",
                found=f"measures of {[t.name for t in measures.trials]} for the fitted recordings {fitted}",
                expected="the measures of the same recordings in the same order",
                next_step="compute the measures from these fits",
                key=self.title,
            )
        of_trial = iter(measures.trials)
        recordings = tuple(r.with_measured(next(of_trial)) if r.fitted else r for r in self.recordings)
        return dataclasses.replace(self, recordings=recordings, measures=measures)

    def with_logs(self, logs: Sequence[Path]) -> Visit:
        """Return the visit with a sensor log of the phone for each fitted recording, in their order, or with none.

        Raises `PblError` USAGE for another number of logs.
        """
        if not logs:
            return self
        if len(logs) != len(self.fitted):
            raise PblError(
                "USAGE",
                found=f"{len(logs)} times --attitude for {len(self.fitted)} fits",
                expected="none, or one for each fit, in the same order",
                next_step="name a log for each fit",
            )
        of_fit = iter(logs)
        recordings = tuple(
            dataclasses.replace(r, load_log=functools.partial(_log_of, next(of_fit), r)) if r.fitted else r
            for r in self.recordings
        )
        return dataclasses.replace(self, recordings=recordings)


def stage_checks(recordings: Sequence[Recording]) -> tuple[Check, ...]:
    """Return the checks of each fitted recording, with its name if there are several, and of those left out."""
    fitted = [r for r in recordings if r.fitted]
    named = [(f" ({r.name})" if len(fitted) > 1 else "", c) for r in fitted for c in r.checks]
    found = [dataclasses.replace(c, check=c.check + name) for name, c in named]
    missing = (r for r in recordings if not r.fitted and r.problem)
    return (*found, *(Check(f"trial {r.name}", WARN, None, None, f"left out: {r.problem}") for r in missing))


def _log_of(path: Path, recording: Recording) -> tuple[PhoneLog, float]:
    log = read_phone_log(path)
    return log, log_shift_s(log, recording.keypoints, str(path))
