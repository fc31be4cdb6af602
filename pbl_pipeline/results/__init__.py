"""Results of computations: frozen records, each with the columns of its row."""

from .cycles import BODY_ANGLES, NO_POSITIONS, Exclusion, GaitCycle, Lengths
from .errors import JointError, TrialError
from .events import EVENTS, FOOT_DOWN, FOOT_UP, LEFT, RIGHT, SIDES, GaitEvent, GaitEvents
from .fits import DepthFit, SensorFit, Solution
from .forces import CycleKinetics, KineticMeasure, Kinetics, Series, TrialKinetics
from .index import Gdi, GdiCycle, MovementProfile, VariableScore
from .measures import OF_VISIT, Z90, Measure
from .people import PersonTrack, SubjectChoice
from .video_facts import FirstPicture, VideoInfo
