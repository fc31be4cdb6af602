"""The report of a visit: one HTML page for people."""

from pbl_pipeline.report._types import Picture
from pbl_pipeline.report._write import write_report

__all__ = ["Picture", "write_report"]
