"""Optional packages: imported when they are used, with a coded error if they are not installed."""

from __future__ import annotations

import importlib
from types import ModuleType

from pbl_pipeline.errors import PblError


def needed(module: str, extra: str, purpose: str) -> ModuleType:
    """The module of a package of an optional extra of this project.

    Raises `PblError` PACKAGE_MISSING, with the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise PblError(
            "PACKAGE_MISSING",
            found=str(error),
            expected=f"the package {module.split('.')[0]} for {purpose}",
            next_step=f"pip install 'pbl-pipeline[{extra}]'",
        ) from error
