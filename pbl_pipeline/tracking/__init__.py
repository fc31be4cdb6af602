"""People in a video: detection, tracks, choice of the subject."""

from ._associate import AssociationParams
from ._blazepose import BlazePoseDetector
from ._require import require_subject
from ._sheet import save_contact_sheet
from ._subject import SUBJECT_DEFAULT, SUBJECT_PARAMSETS, SubjectParams, choose_subject, time_in_view_s
from ._track import DEFAULT, DETECTORS, PARAMSETS, TrackingParams, track_people
from ._types import Detection, PersonDetector, PersonTrack, SubjectChoice, Tracking

__all__ = [
    "DEFAULT",
    "DETECTORS",
    "PARAMSETS",
    "SUBJECT_DEFAULT",
    "SUBJECT_PARAMSETS",
    "AssociationParams",
    "BlazePoseDetector",
    "Detection",
    "PersonDetector",
    "PersonTrack",
    "SubjectChoice",
    "SubjectParams",
    "Tracking",
    "TrackingParams",
    "choose_subject",
    "require_subject",
    "save_contact_sheet",
    "time_in_view_s",
    "track_people",
]
