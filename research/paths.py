"""Paths of the shipped files and the development recordings."""

from pathlib import Path

import pbl_pipeline

#: The folder of the package in this checkout.
PACKAGE = Path(pbl_pipeline.__file__).parent
#: The development recordings beside the project.
SHARED = PACKAGE.parent.parent / "shared" / "data"
