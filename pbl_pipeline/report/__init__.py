"""The report of a visit: one HTML page for people."""

from pbl_pipeline.report._figures import Picture
from pbl_pipeline.report.page import write_report
