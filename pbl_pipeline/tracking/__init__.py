"""People in a video: detection, tracks and choice of the subject."""

from pbl_pipeline.results import PersonTrack, SubjectChoice

from .appearance import appearance_of, appearance_similarity
from .associate import AssociationParams
from .blazepose import BlazePoseDetector, BlazePoseWindows, body_box, circle_roi
from .detection_schedule import WatchParams
from .identity_swaps import UncrossParams
from .methods import METHODS, SUBJECT_METHODS, detector_params
from .params import TrackingParams
from .reidentify import JoinParams
from .subject_choice import (
    FILM_THE_WHOLE_BODY,
    carried_choice,
    choose_subject,
    contact_sheet,
    contact_sheet_jpeg,
    require_subject,
    same_person,
    save_contact_sheet,
)
from .tiling import tiles
from .track import track_people
from .types import Detection, PersonDetector, Tracking, WindowDetector
from .walker_score import SubjectParams, step_s, time_in_view_s
from .yolox import YoloxDetector
