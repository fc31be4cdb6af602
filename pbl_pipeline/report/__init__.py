"""The report of a visit: one HTML page for people."""

from pbl_pipeline.report.page import write_report
from pbl_pipeline.report.types import Picture
