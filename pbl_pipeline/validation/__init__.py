"""How far a fit is from a reference: errors per joint, the paper's tables, paired curves (docs/validation.md)."""

from ._align import align_path, best_lag
from ._compare import JointError, KinematicErrors, compare, compare_angles, compare_references
from ._corpus import Case, Walk, corpus, detector_model, is_held_out, lasting, recorded_walks, synthetic_walk
from ._corpus_errors import corpus_errors, corpus_tables, print_corpus, responsiveness, write_corpus
from ._curves import CURVE_COLUMNS, cycle_curves, save_curves
from ._frame import COLUMNS, TrialErrors, error_frame
from ._head_coverage import (
    BAR,
    HeadCoverage,
    LocatedClip,
    LocatedHead,
    frame_coverage,
    head_coverage,
    located_clips,
)
from ._joints import JOINTS_CLIP, JOINTS_OPENCAP, JOINTS_PAPER
from ._motions import ACTIVITIES, Motion, read_index, read_motion, read_motions, stride_s
from ._paper import paper_figures
from ._paper_tables import paper_tables
from ._point_truth import PointTruth, resect, truth_of_bodies, truth_of_synthetic, truth_of_trc
from ._reference import BODY_ROTATIONS, CONVENTIONS, QPOS, Reference
from ._reliability import (
    RELIABILITY_COLUMNS,
    PointErrors,
    point_errors,
    reliability_table,
)
from ._reliability_page import write_reliability
from ._rotations import body_rotation_angles
from ._sources import (
    fit_angles,
    fit_angles_sd,
    reference_of_bodies,
    reference_of_fit,
    reference_of_mot,
    reference_of_qpos,
)
from ._statistics import median_niqr, niqr
from ._table import Cell, Table
from ._true_fit import fit_of_qpos
from ._view import view_classes
from ._write import html, latex, print_tables, write_tables

__all__ = [
    "ACTIVITIES",
    "BAR",
    "BODY_ROTATIONS",
    "COLUMNS",
    "CONVENTIONS",
    "CURVE_COLUMNS",
    "JOINTS_CLIP",
    "JOINTS_OPENCAP",
    "JOINTS_PAPER",
    "QPOS",
    "RELIABILITY_COLUMNS",
    "Case",
    "Cell",
    "HeadCoverage",
    "JointError",
    "KinematicErrors",
    "LocatedClip",
    "LocatedHead",
    "Motion",
    "PointErrors",
    "PointTruth",
    "Reference",
    "Table",
    "TrialErrors",
    "Walk",
    "align_path",
    "best_lag",
    "body_rotation_angles",
    "compare",
    "compare_angles",
    "compare_references",
    "corpus",
    "corpus_errors",
    "corpus_tables",
    "cycle_curves",
    "detector_model",
    "error_frame",
    "fit_angles",
    "fit_angles_sd",
    "fit_of_qpos",
    "frame_coverage",
    "head_coverage",
    "html",
    "is_held_out",
    "lasting",
    "latex",
    "located_clips",
    "median_niqr",
    "niqr",
    "paper_figures",
    "paper_tables",
    "point_errors",
    "print_corpus",
    "print_tables",
    "read_index",
    "read_motion",
    "read_motions",
    "recorded_walks",
    "reference_of_bodies",
    "reference_of_fit",
    "reference_of_mot",
    "reference_of_qpos",
    "reliability_table",
    "resect",
    "responsiveness",
    "save_curves",
    "stride_s",
    "synthetic_walk",
    "truth_of_bodies",
    "truth_of_synthetic",
    "truth_of_trc",
    "view_classes",
    "write_corpus",
    "write_reliability",
    "write_tables",
]
