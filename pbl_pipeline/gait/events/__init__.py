"""Initial contact and toe-off (`foot_down`, `foot_up`) of both sides."""

from pbl_pipeline.results.events import EVENTS, FOOT_DOWN, FOOT_UP, LEFT, RIGHT, SIDES, GaitEvent, GaitEvents

from ._correction import apply_correction, check_correction
from ._detect import detect_events
from ._foot_velocity import FootVelocityParams
from ._preconditions import check_preconditions
from .methods import METHODS
from .phase import PHASE_ORDER, PhaseParams, candidates
from .phase_filter import FilterParams
from .types import EventParams, load_events, no_events
from .walking import WalkingParams
