"""The report of a session: one HTML page for people."""

from pbl_pipeline.report._types import Picture, SessionReport, TrialReport
from pbl_pipeline.report._write import write_report

__all__ = ["Picture", "SessionReport", "TrialReport", "write_report"]
