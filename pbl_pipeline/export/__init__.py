"""Results in the formats of other programs (docs/export.md)."""

from pbl_pipeline.export.bids import Labels
from pbl_pipeline.export.writer import FORMATS, GAIT_FORMATS, ExportOptions, check_export, write_export
from pbl_pipeline.fit.angles_file import angles_table, write_angles_csv
