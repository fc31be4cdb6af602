"""Results in the formats of other programs."""

from pbl_pipeline.export._angles import angles_table, write_angles_csv

__all__ = ["angles_table", "write_angles_csv"]
