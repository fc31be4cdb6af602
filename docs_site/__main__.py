"""python -m docs_site [FOLDER]: build the site into FOLDER/site (default: build/docs)."""

from __future__ import annotations

import sys
from pathlib import Path

from . import BUILT, BuildError, build

try:
    print(build(Path(sys.argv[1]) if len(sys.argv) > 1 else BUILT) / "index.html")  # noqa: T201
except BuildError as error:
    sys.exit(str(error))
