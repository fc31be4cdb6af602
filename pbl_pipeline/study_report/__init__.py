"""Report of a study: statistics, figures, tables and one page (docs/study.md)."""

from .figures import Figure
from .page import study_figures, write_study_report
from .page_tables import PageTable, all_tables
from .results import CurveResult, StudyResults, study_results
from .visit_values import Plan, mean_curves, pairs, plan, visit_table
