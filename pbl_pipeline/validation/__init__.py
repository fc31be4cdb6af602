"""Comparison of a fit with a reference: errors per joint, the paper's tables, paired curves (docs/validation.md)."""

from pbl_pipeline.results import JointError

from .align import align_path
from .bridge import bridge_pairs, bridge_table, folder_values, refit_bridge_set, touched
from .compare import (
    CURVE_COLUMNS,
    OF_OTHERS,
    KinematicErrors,
    compare,
    compare_angles,
    cycle_curves,
    median_niqr,
    save_curves,
)
from .paper_tables import COLUMNS, TrialErrors, error_frame, paper_tables
from .reference import BODY_ROTATIONS, JOINTS_CLIP, JOINTS_OPENCAP, JOINTS_PAPER, QPOS, Reference, view_classes
from .sources import (
    fit_angles,
    fit_angles_sd,
    reference_of_bodies,
    reference_of_fit,
    reference_of_mot,
    reference_of_qpos,
)
from .write import (
    INDEX_COLUMNS,
    Cell,
    Table,
    html,
    index_agreement,
    index_pairs,
    latex,
    paper_figures,
    print_tables,
    write_tables,
)
