"""Whether a single trial can take part in a session fit, asked before the session is put together."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.paramset import Paramset

from ._params import DEFAULT, PARAMSETS, params_of
from ._problem import make_session


def check_trial(keypoints: Keypoints, name: str, paramset: Paramset | None = None) -> tuple[np.ndarray, float]:
    """Frames that `fit_session` would use, (T,) bool, and the share (0..1) of frames with the whole person in view.

    Raises
    ------
    PblError
        FIT_INPUT, MARKER_SET_UNKNOWN: `fit_session` with this trial would raise the same for the whole session.
    """
    session = make_session([keypoints], [name], params_of(paramset or PARAMSETS[DEFAULT]).view)
    return session.used[0], float(session.in_view_share[0])
