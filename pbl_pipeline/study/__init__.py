"""A study of visits and clinical scores as frames and as one folder, without a database (docs/study.md)."""

from .frame_columns import CURVE_PERCENT, CURVE_POINTS, FRAMES, KEYS, SIDES, Column
from .study_folder import content_hash, data_dictionary, read_study, write_study
from .subject_codes import deidentified
from .types import FIRST_ROLES, StudyData, StudyDescription, classes_of, minimal_change_at
