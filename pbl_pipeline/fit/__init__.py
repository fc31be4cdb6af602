from ._types import SessionFit, TrialFit
