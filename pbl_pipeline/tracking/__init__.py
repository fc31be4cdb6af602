from ._types import Detection, PersonDetector, PersonTrack, SubjectChoice, Tracking
