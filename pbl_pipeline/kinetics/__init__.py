"""Ground reactions, joint moments and powers from the fitted motion, with their error (docs/kinetics.md)."""

from pbl_pipeline.results import CycleKinetics, KineticMeasure, Kinetics, Series, TrialKinetics

from .compute import REASONS, TOO_UNCERTAIN, visit_kinetics
from .dynamics import GRAVITY, Dynamics, Motion, inverse_dynamics, smooth_motion
from .ground import GroundReaction, contact_of, ground_reaction
from .inertia import Inertia, segment_inertia
from .joints import JOINTS, MOMENTS, generalised_without, leg_moments
from .methods import METHODS
from .types import CURVES, MEASURES, KineticsParams, Walk
