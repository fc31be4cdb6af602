"""Results of fitting the body of a visit, without the movements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pbl_pipeline.records import column, record, stored


@record
class Solution:
    """Result of fitting the body of a visit, without the movements."""

    solver: str = column("solver", type="varchar(32)")
    params_hash: str
    iterations: int | None = column(
        "fit_iterations", "steps of the solver, null for fits of before it was recorded", "int32"
    )
    converged: bool | None = column(
        "fit_converged", "ended at a minimum, not at its bound on iterations or steps; null too", "bool"
    )
    #: (8,) multipliers of `body.SCALE_NAMES`.
    scale: np.ndarray = column(
        "fit_scale", "multiplier (-) of each scale group, 1 = the unscaled body", "json", digits=5
    )
    loss_trace: np.ndarray  # (K, 2) step, loss
    seconds: float
    compile_seconds: float = column("compile_seconds", "(s) of the duration, spent compiling")
    device: str = column("compute_device", "what JAX computed on", "varchar(64)")
    software: str = ""  # version and commit of the code
    result: str | None = column(
        "fit_result",
        "why the solver ended: small_step, small_gain or max_steps_reached; null: not recorded",
        "varchar(32)",
        before="scale",
        default=None,
    )

    @property
    @stored("fit_loss", "(-) total loss at the end", before="iterations")
    def loss(self) -> float:
        """Total loss at the end."""
        return float(self.loss_trace[-1, 1])


@record
class Residuals:
    """Medians over frames and points, None where nothing was seen."""

    px: float | None = column("{}_residual_2d", "(px) median distance of body and keypoints in the picture")
    cm: float | None = column("{}_residual_3d", "(cm) median distance of body and 3D keypoints")

    @classmethod
    def of(cls, trials: Sequence[Any]) -> Residuals:
        """Return the residuals of fitted trials (`TrialFit`) together."""
        px, m = (np.concatenate([getattr(t, n).ravel() for t in trials]) for n in ("residual_2d_px", "residual_3d_m"))
        return cls(*(float(np.median(s)) if len(s := v[np.isfinite(v)]) else None for v in (px, 100 * m)))


@record
class DepthFit:
    """Results of a fit for the depth recording of one trial."""

    name: str = column("depths_name", "name of the recording", "varchar(255)")
    sha256: str = column("depths_sha256", "of its bytes, of a folder those of its zip", "char(64)")
    used: float = column("depths_used", "(-) share of the used frames' large joints with a depth that was used")
    fits: float = column("depths_fits", "(-) share of the depths of joints in sight that lie on the person", null=True)
    z: float = column("depths_z", "(-) their error in standard deviations, root mean square", null=True)
    distance: float = column("depths_distance", "(-) distance of the fit without depths over theirs, of the visit")
    metre: float = column("depths_metre", "(-) metres of the fit in one of theirs, by which it is divided, of a visit")


@record
class TrialFigures:
    """A fitted trial in figures."""

    name: str = column("trial_name", type="varchar(255)", cut=True)
    n_fitted: int = column("trial_n_fitted", "frames with joint angles", "int32")
    residuals: Residuals
    orientation: str = column(  # no enum: DataJoint 2.3.5 cannot read one back whose values hold a colon
        "trial_orientation",
        "where the vertical comes from, such as 'measured: phone', null where it was not recorded",
        "varchar(32)",
        null=True,
    )
    clock_offset_s: float = column(
        "trial_clock_offset", "(s) the phone sensor's clock minus the video's, null where not estimated", null=True
    )


@record
class SensorFit:
    """Results of a fit for a sensor in one trial; NaN where it was not measured or not stated."""

    segment: str = column("sensor_segment", "segment of the body, such as shank_r", "varchar(8)", key=True)
    name: str = column("sensor_name", "its name in the log", "varchar(255)")
    moves_with: str = column("sensor_moves_with", "segment whose motion it shows, mostly the stated one", "varchar(8)")
    mounting: np.ndarray = column(
        "sensor_mounting", "quaternion (w, x, y, z) from its axes to the segment, of the visit", "json", digits=6
    )
    bias_rad_s: np.ndarray = column(
        "sensor_bias", "(rad/s) of its gyroscope, three axes, beyond what its filter took off", "json", digits=6
    )
    heading_rad: float = column("sensor_heading", "(rad) of its world in that of the camera", null=True)
    tilt_rad: float = column("sensor_tilt", "(rad) of its world against that of the camera", null=True)
    clock_s: float = column("sensor_clock", "(s) its time at the start of the video", null=True)
    off_s: float = column("sensor_clock_off", "(s) how far that is from where the wall clocks state it", null=True)
    gain: float = column("sensor_gain", "(-) how much faster its clock runs", null=True)
    z: float = column("sensor_z", "(-) its error in standard deviations, root mean square", null=True)
    dropped: float = column("sensor_dropped", "(-) share of frames in which it was not measured, or errs by far")
    slip: float = column("sensor_slip", "(-) turn on the segment from first to last third, in likely ones", null=True)
    rate_rad_s: float = column("sensor_rate", "(rad/s) its angular velocity, root mean square", null=True)
