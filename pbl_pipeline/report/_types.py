"""What a report is made of."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from pbl_pipeline.fit import SessionFit, TrialFit
from pbl_pipeline.gait import GaitMetrics, NormativeSet
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.qc import Check
from pbl_pipeline.tracking import SubjectChoice
from pbl_pipeline.video import VideoInfo


@dataclasses.dataclass(frozen=True)
class Picture:
    """One frame with the fitted body drawn over it, as `render.overlay_frames` gives it: (H, W, 3) uint8 BGR."""

    index: int
    time_s: float
    image: np.ndarray


@dataclasses.dataclass(frozen=True)
class TrialReport:
    """One recording. What a stage did not produce is None (no person found: no fit), with a sentence in `problem`."""

    name: str
    video: VideoInfo
    choice: SubjectChoice | None = None
    fit: TrialFit | None = None
    keypoints: Keypoints | None = None
    pictures: tuple[Picture, ...] = ()
    problem: str = ""


@dataclasses.dataclass(frozen=True)
class SessionReport:
    """Everything `write_report` shows.

    title, subject_code, date
        Of the visit; shown as they are, so the subject's code, never a name.
    trials
        In the order they were fitted. The trials that have a fit are those of `metrics`, in its order.
    metrics, session
        None where the chain ended before.
    norm
        Of the bands; None for the set that `metrics` names, where it is one that ships.
    checks
        Outcomes of stages before the fit, such as those of the video; the fit's and the gait's own are added.
    origin
        Further provenance: heading -> {name: value}, for example {"Software": {"Version": "0.1.0"}}.
    """

    title: str
    subject_code: str
    date: str
    trials: tuple[TrialReport, ...]
    metrics: GaitMetrics | None
    session: SessionFit | None
    norm: NormativeSet | None = None
    checks: tuple[Check, ...] = ()
    origin: Mapping[str, Mapping[str, str]] = dataclasses.field(default_factory=dict)
