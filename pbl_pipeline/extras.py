"""Optional packages: imported when they are used, with a coded error if they are not installed."""

from __future__ import annotations

import importlib
from types import ModuleType

from pbl_pipeline.errors import PblError

#: Module of an optional package -> the extra that brings it.
EXTRAS = {"ezc3d": "export", "pyarrow": "export", "matplotlib": "figures", "h5py": "h5", "lzfse": "depth"}


def needed(module: str, purpose: str) -> ModuleType:
    """The module of an optional package. Raises `PblError` PACKAGE_MISSING, with the command that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise absent(error, module, purpose) from error


def absent(error: ImportError, module: str, purpose: str = "this step") -> PblError:
    """PACKAGE_MISSING for a module of another package that is not installed, or only in parts."""
    package = module.partition(".")[0]
    extra = EXTRAS.get(package)
    return PblError(
        "PACKAGE_MISSING",
        found=str(error),
        expected=f"the package {package} for {purpose}",
        next_step=f"pip install 'pbl-pipeline[{extra}]'" if extra else "`pbl doctor` says how to mend it",
    )
