"""People in a video: detection, tracks, choice of the subject."""

from ._appearance import appearance_of, appearance_similarity
from ._choose import choose_subject
from ._detection_schedule import WatchParams
from ._params import TrackingParams
from ._registered import detector_params
from ._require import FILM_THE_WHOLE_BODY, require_subject
from ._sheet import contact_sheet, contact_sheet_jpeg, save_contact_sheet
from ._subject import SubjectParams, step_s, time_in_view_s
from ._transfer_choice import carried_choice, same_person
from .associate import AssociationParams
from .blazepose import BlazePoseDetector, body_box, circle_roi
from .identity_swaps import UncrossParams
from .methods import METHODS, SUBJECT_METHODS
from .reidentify import JoinParams
from .tiling import tiles
from .track import track_people
from .types import Detection, PersonDetector, PersonTrack, SubjectChoice, Tracking
from .yolox import YoloxDetector

__all__ = [
    "FILM_THE_WHOLE_BODY",
    "METHODS",
    "SUBJECT_METHODS",
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
    "appearance_of",
    "appearance_similarity",
    "body_box",
    "carried_choice",
    "choose_subject",
    "circle_roi",
    "contact_sheet",
    "contact_sheet_jpeg",
    "detector_params",
    "require_subject",
    "same_person",
    "save_contact_sheet",
    "step_s",
    "tiles",
    "time_in_view_s",
    "track_people",
]
