"""Reference movements of videos, and the error of every fit against them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pbl_pipeline.records import definition, to_row
from pbl_pipeline.results import JointError, TrialError

from . import fit, session, video  # noqa: F401  definitions refer to session and video
from .datajoint_setup import dj
from .origin import Origin, computes, origin_columns
from .record_parts import part_of
from .rows import one
from .stored_files import file_ref, read_stored

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
    {definition(TrialError)}
    {origin_columns("error")}
    """

    Joint = part_of("Joint", JointError)

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

        return (lib.compare(fit.load_trial(fitted), read_stored(reference, lib.Reference.load)),)

    def make_insert(self, key: dict, errors: lib.KinematicErrors, origin: Origin) -> None:
        from pbl_pipeline.validation import OF_OTHERS

        self.insert1({**fit.of_session(key), **to_row(errors, without=OF_OTHERS), **origin.row("error")})
        self.Joint.insert_records(key, errors.joints)
