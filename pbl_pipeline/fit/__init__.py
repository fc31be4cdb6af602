"""The session fit: keypoints of 1..N trials to joint angles, one body for all."""

from ._types import SessionFit, TrialFit

__all__ = ["SessionFit", "TrialFit"]
