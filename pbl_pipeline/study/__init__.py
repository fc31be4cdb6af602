"""A study of visits and clinical scores as frames and as one folder, without a database (docs/study.md)."""

from .study_folder import content_hash, data_dictionary, deidentified, read_study, write_study
from .types import (
    CURVE_PERCENT,
    CURVE_POINTS,
    FIRST_ROLES,
    FRAMES,
    KEYS,
    Column,
    StudyData,
    StudyDescription,
    classes_of,
    minimal_change_at,
)
