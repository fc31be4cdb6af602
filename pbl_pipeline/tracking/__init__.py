"""People in a video: detection, tracks, choice of the subject."""

from ._appearance import likeness, look_of
from ._associate import AssociationParams
from ._blazepose import BlazePoseDetector, body_box, box_iou, circle_roi
from ._detection_schedule import WatchParams
from ._identity_swaps import UncrossParams
from ._methods import find_method, method_of_detector
from ._reidentify import JoinParams
from ._require import require_subject
from ._sheet import contact_sheet, contact_sheet_jpeg, save_contact_sheet
from ._subject import SUBJECT_DEFAULT, SUBJECT_PARAMSETS, SubjectParams, choose_subject, time_in_view_s
from ._track import DEFAULT, DETECTORS, PARAMSETS, TrackingParams, track_people
from ._transfer_choice import carried_choice, same_person
from ._types import Detection, PersonDetector, PersonTrack, SubjectChoice, Tracking
from ._yolox import YoloxDetector

__all__ = [
    "DEFAULT",
    "DETECTORS",
    "PARAMSETS",
    "SUBJECT_DEFAULT",
    "SUBJECT_PARAMSETS",
    "AssociationParams",
    "BlazePoseDetector",
    "Detection",
    "JoinParams",
    "PersonDetector",
    "PersonTrack",
    "SubjectChoice",
    "SubjectParams",
    "Tracking",
    "TrackingParams",
    "UncrossParams",
    "WatchParams",
    "YoloxDetector",
    "body_box",
    "box_iou",
    "carried_choice",
    "choose_subject",
    "circle_roi",
    "contact_sheet",
    "contact_sheet_jpeg",
    "find_method",
    "likeness",
    "look_of",
    "method_of_detector",
    "require_subject",
    "same_person",
    "save_contact_sheet",
    "time_in_view_s",
    "track_people",
]
