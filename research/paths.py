"""Where the shipped files lie."""

from pathlib import Path

import pbl_pipeline

#: The folder of the package in this checkout.
PACKAGE = Path(pbl_pipeline.__file__).parent
