"""Errors of a trial against a reference, and of each joint."""

from __future__ import annotations

import math

from pbl_pipeline.records import column, record


@record
class JointError:
    """Error of one joint over the common frames, error = fit - reference, degrees.

    n: frames with both values. median_abs_deg, mean_abs_deg: of |error|. bias_deg: mean error. sd_deg: sd of the error
    (ddof 0), which is its rms without the constant part. rms_deg: bias and sd together. correlation: Pearson's, NaN
    where one of the two does not move. within_90: fraction of the frames inside `Z90` sd of the fit, NaN without sd.
    normal_p: p of the Shapiro-Wilk test of the errors of the frames, NaN for fewer than three or errors all the same.
    """

    joint: str = column(
        "error_joint", "OpenSim's name; the knee as knee_flexion, positive in flexion", "varchar(32)", key=True
    )
    n: int = column("joint_n", "frames compared; where there is none, all below are null", "int32")
    median_abs_deg: float = column("joint_median_abs", "(deg) median absolute error", null=True)
    mean_abs_deg: float = column("joint_mean_abs", "(deg) mean absolute error", null=True)
    bias_deg: float = column("joint_bias", "(deg) mean of fit minus reference", null=True)
    sd_deg: float = column("joint_sd", "(deg) standard deviation of fit minus reference", null=True)
    rms_deg: float = column("joint_rms", "(deg) root of its mean square", null=True)
    correlation: float = column("joint_correlation", "(-1..1) null where one of the two does not move", null=True)
    within_90: float = column(
        "joint_within_90", "(0..1) share of frames inside the fit's 90 percent interval, or null", null=True
    )
    normal_p: float = column(
        "joint_normal_p", "(0..1) p of Shapiro-Wilk of the errors of the frames, or null", null=True, default=math.nan
    )


@record(kw_only=True)
class TrialError:
    """Error of one trial over the common frames, NaN where it is not known."""

    lag_s: float = column("error_lag", "(s) found by comparison; positive: the video is later than the reference")
    #: A lag at its end is suspicious (`KinematicErrors.lag_at_limit`).
    max_lag_s: float = column("error_max_lag", "(s) how far it was searched to both sides", default=math.nan)
    n: int = column("error_n", "frames compared", "int32")  # in which at least one joint could be compared
    #: Of `JOINTS_PAPER` that are known: the paper's error of a trial.
    median_abs_deg: float = column(
        "error_median_abs", "(deg) median absolute error over all frames and the paper's joints", null=True
    )
    rte_m: float = column("rte", "(m) mean distance of the pelvis paths after alignment, null where unknown", null=True)
    view_left: str = column(  # as of `view_classes`
        "error_view_left",
        "joints of the left side seen from: front, back, ipsilateral, contralateral, mixed (also without a camera)",
        "varchar(16)",
        default="mixed",
    )
    view_right: str = column("error_view_right", "the same for the right side", "varchar(16)", default="mixed")
