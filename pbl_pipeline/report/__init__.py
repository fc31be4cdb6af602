"""Report of a visit: one HTML page."""

from pbl_pipeline.report._figures import Picture, picture
from pbl_pipeline.report.page import write_report
