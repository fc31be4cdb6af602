"""A visit with all its results, and its folder of files.

`pipeline.run_visit` makes a `Visit` from videos, `load_visit` reads it from its folder, and
`pbl_schemas.load_visit` from the tables. Report, overlay, exports and web pages take a `Visit` and compute
nothing themselves.
"""

from pbl_pipeline.results import Solution

from .files import (
    FIT,
    METRICS,
    OVERLAY,
    REPORT,
    SESSION,
    load_kinetics,
    load_visit,
    name_of_fit,
    recording_facts,
    save_beside,
    save_kinetics,
    save_visit,
    visit_facts,
    visit_of_fits,
)
from .types import Held, Recording, Visit, solution_of
