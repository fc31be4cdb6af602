"""Build hook: wheel and source archive carry the commit they were built from (`pbl_pipeline/code_version.py`)."""

from __future__ import annotations

import importlib.util
import os
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface  # pyright: ignore[reportMissingImports]

TARGET = "pbl_pipeline/_commit.txt"


class CommitHook(BuildHookInterface):
    """Adds `_commit.txt`: the variable PBL_COMMIT (an image is built without the repository), else git's."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called before a wheel or source archive is built."""
        root = Path(self.root)
        if version == "editable" or (root / TARGET).is_file():  # a checkout is asked when it runs; an archive has it
            return
        commit = os.environ.get("PBL_COMMIT") or _checked_out_commit(root)
        if commit:
            self._folder = tempfile.TemporaryDirectory(prefix="pbl-build-")  # removed with the hook
            file = Path(self._folder.name) / "_commit.txt"
            file.write_text(commit + "\n")
            build_data["force_include"][str(file)] = TARGET


def _checked_out_commit(root: Path) -> str:
    """By the function of the package, loaded from its file: the package itself needs what is not installed here."""
    spec = importlib.util.spec_from_file_location("code_version", root / "pbl_pipeline" / "code_version.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.checked_out_commit(root)
