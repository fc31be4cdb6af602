"""People in a video: detection, tracks, choice of the subject."""

from ._types import Detection, PersonDetector, PersonTrack, SubjectChoice, Tracking

__all__ = ["Detection", "PersonDetector", "PersonTrack", "SubjectChoice", "Tracking"]
