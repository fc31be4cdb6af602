"""Results in the formats of other programs (docs/export.md)."""

from pbl_pipeline.export._angles import angles_table, write_angles_csv
from pbl_pipeline.export._from_files import log_shift_s, session_of_files
from pbl_pipeline.export._trial import ExportTrial
from pbl_pipeline.export._write import (
    FORMATS,
    GAIT_FORMATS,
    ExportOptions,
    ExportSession,
    check_export,
    write_export,
)

__all__ = [
    "FORMATS",
    "GAIT_FORMATS",
    "ExportOptions",
    "ExportSession",
    "ExportTrial",
    "angles_table",
    "check_export",
    "log_shift_s",
    "session_of_files",
    "write_angles_csv",
    "write_export",
]
