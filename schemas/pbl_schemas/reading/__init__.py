"""Reading the tables: visits and recordings as the library's objects."""

from ..gait import load_cycles, load_events
from .objects import load_fit_checks, load_keypoints, load_metrics, load_tracking, load_trial_fit
from .visits import fitted_visit, list_fitted, load_recording, load_visit, load_visits
