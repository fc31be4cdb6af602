"""Reference movements of videos, and the error of every fit against them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline.records import number

from . import fit, session, video  # noqa: F401  definitions refer to session and video
from .datajoint_setup import dj
from .origin import Origin, computes, origin_columns
from .rows import one, or_nan
from .stored_files import file_ref, stored_file

if TYPE_CHECKING:
    from pbl_pipeline import validation as lib

schema = dj.Schema()


@schema
class ReferenceKinematics(dj.Manual):
    definition = """
    # movement of a video as another instrument measured it; another file of the same source is another row
    -> video.Video
    reference             : char(16)           # hash over source, convention, shift and file
    ---
    dataset               : varchar(32)        # collection of recordings that is reported together
    reference_source      : varchar(64)        # instrument, such as optical markers or several cameras
    reference_convention  : enum('qpos', 'body_rotations')  # what its angles are: joints of our body, or rotations between bodies
    reference_name        : varchar(255)       # name of the file
    reference_sha256      : char(64)           # of the file's bytes
    reference_origin      : varchar(1000)      # where the file comes from
    reference_shift       : float64            # (s) added to the file's time stamps to be on the clock of the video
    reference_n           : int32              # samples
    reference_start       : float64            # (s) first sample, in the time of the video
    reference_end         : float64            # (s) last sample
    reference_joints      : json               # names of its angles
    reference_current     : bool               # false once a newer file of the same source took its place; old errors stay
    reference_created     : datetime           # when registered, UTC
    reference_file        : <object@arrays>    # npz: time_s (T) s, names (A), angles_deg (T,A) deg, pelvis_m (T,3) m; docs/files.md
    """  # noqa: E501


@schema
class KinematicError(dj.Computed):
    definition = f"""
    # error of a fitted trial against a reference
    -> fit.SessionFit.Trial
    -> ReferenceKinematics
    ---
    -> session.Session
    error_lag             : float64            # (s) found by comparison; positive: the video is later than the reference
    error_max_lag         : float64            # (s) how far it was searched to both sides
    error_n               : int32              # frames compared
    error_median_abs=null : float64            # (deg) median absolute error over all frames and the paper's joints
    rte=null              : float64            # (m) mean distance of the pelvis paths after alignment, null where unknown
    error_view_left       : varchar(16)        # joints of the left side seen from: front, back, ipsilateral, contralateral, mixed (also without a camera)
    error_view_right      : varchar(16)        # the same for the right side
    {origin_columns("error")}
    """  # noqa: E501

    class Joint(dj.Part):
        definition = """
        -> master
        error_joint           : varchar(32)    # OpenSim's name; the knee as knee_flexion, positive in flexion
        ---
        joint_n               : int32          # frames compared; where there is none, all below are null
        joint_median_abs=null : float64        # (deg) median absolute error
        joint_mean_abs=null   : float64        # (deg) mean absolute error
        joint_bias=null       : float64        # (deg) mean of fit minus reference
        joint_sd=null         : float64        # (deg) standard deviation of fit minus reference
        joint_rms=null        : float64        # (deg) root of its mean square
        joint_correlation=null: float64        # (-1..1) null where one of the two does not move
        joint_within_90=null  : float64        # (0..1) share of frames inside the fit's 90 percent interval, or null
        joint_normal_p=null   : float64        # (0..1) p of Shapiro-Wilk of the errors of the frames, or null
        """

    @property
    def key_source(self) -> Any:
        trials = fit.SessionFit.Trial.proj() & fit.current()
        return trials * (ReferenceKinematics & {"reference_current": True}).proj()

    def make_fetch(self, key: dict) -> tuple:
        return (
            file_ref(one(fit.SessionFit.Trial & key, "trial_file")),
            file_ref(one(ReferenceKinematics & key, "reference_file")),
        )

    @computes
    def make_compute(
        self, key: dict, fitted: Mapping[str, Any], reference: Mapping[str, Any]
    ) -> tuple[lib.KinematicErrors]:
        from pbl_pipeline import validation as lib

        with stored_file(reference) as path:
            truth = lib.Reference.load(path)
        return (lib.compare(fit.load_trial(fitted), truth),)

    def make_insert(self, key: dict, errors: lib.KinematicErrors, origin: Origin) -> None:
        self.insert1(
            {
                **key,
                "session_id": fit.session_of_set(key),
                "error_lag": errors.lag_s,
                "error_max_lag": errors.max_lag_s,
                "error_n": errors.n,
                "error_median_abs": number(errors.median_abs_deg),
                "rte": number(errors.rte_m),
                "error_view_left": errors.view["left"],
                "error_view_right": errors.view["right"],
                **origin.row("error"),
            }
        )
        joints = ({column: getattr(j, field) for field, column in JOINT_COLUMNS.items()} for j in errors.joints)
        self.Joint.insert(
            {**key, **{c: v if c in ("error_joint", "joint_n") else number(v) for c, v in row.items()}}
            for row in joints
        )


#: Field of the library's `JointError` -> column of KinematicError.Joint.
JOINT_COLUMNS = {
    "joint": "error_joint",
    "n": "joint_n",
    "median_abs_deg": "joint_median_abs",
    "mean_abs_deg": "joint_mean_abs",
    "bias_deg": "joint_bias",
    "sd_deg": "joint_sd",
    "rms_deg": "joint_rms",
    "correlation": "joint_correlation",
    "within_90": "joint_within_90",
    "normal_p": "joint_normal_p",
}


def _fields(joint: Mapping[str, Any]) -> dict[str, Any]:
    values = {field: joint[column] for field, column in JOINT_COLUMNS.items()}
    return {k: v if k in ("joint", "n") else or_nan(v) for k, v in values.items()}


def errors_of_rows(row: Mapping[str, Any], joints: Sequence[Mapping[str, Any]]) -> lib.KinematicErrors:
    """The library's `KinematicErrors` from a row of KinematicError joined with its trial and reference, and its joints.

    The residuals are those of the trial, which are not stored again here.
    """
    from pbl_pipeline import validation as lib

    return lib.KinematicErrors(
        trial=row["trial_name"],
        reference=row["reference_name"],
        source=row["reference_source"],
        convention=row["reference_convention"],
        lag_s=float(row["error_lag"]),
        max_lag_s=float(row["error_max_lag"]),
        n=int(row["error_n"]),
        joints=tuple(lib.JointError(**_fields(j)) for j in joints),
        median_abs_deg=or_nan(row["error_median_abs"]),
        rte_m=or_nan(row["rte"]),
        view={"left": row["error_view_left"], "right": row["error_view_right"]},
        residual_2d_px=or_nan(row["trial_residual_2d"]),
        residual_3d_cm=or_nan(row["trial_residual_3d"]),
    )
