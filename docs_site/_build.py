"""From the repository to the folder that zensical builds, and the build.

Pages come from several places: docs/, the READMEs of the rooms, notebooks, commands and docstrings. A link to a page is
rewritten to where that page is staged; a link to any other file of the repository becomes its path as text.
"""

from __future__ import annotations

import os
import posixpath
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from . import _notebook, api, commands

ROOT = Path(__file__).resolve().parents[1]
#: Where `make docs` builds, ignored by git.
BUILT = ROOT / "build" / "docs"
_HERE = Path(__file__).resolve().parent
_FENCE = re.compile(r"^(```.*?^```[^\n]*$)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")


class BuildError(RuntimeError):
    """The site could not be built; the text is what zensical printed."""


def pages() -> dict[str, str]:
    """Path in the repository -> path in the site, of every page that is written by hand."""
    found = {"README.md": "readme.md", "CHANGELOG.md": "changelog.md"}
    found |= {"CONTRIBUTING.md": "contributing.md", "SECURITY.md": "report_a_vulnerability.md"}
    found |= {f"docs/{p.name}": p.name for p in sorted((ROOT / "docs").glob("*.md"))}
    found |= {
        f"docs/notebooks/{p.name}": f"notebooks/{p.stem}.md" for p in sorted((ROOT / "docs/notebooks").glob("*.ipynb"))
    }
    for room in ("pbl_pipeline", "pbl_pipeline/fit", "schemas", "workers", "research", "tests", "docs_site"):
        found[f"{room}/README.md"] = f"rooms/{posixpath.basename(room)}.md"
    return found


def stage(folder: Path) -> Path:
    """Write `folder`/zensical.toml and all pages below `folder`/src, and return the latter."""
    src, where = folder / "src", pages()
    shutil.rmtree(src, ignore_errors=True)
    texts = commands.pages() | api.pages(ROOT)
    for path, target in where.items():
        file = ROOT / path
        text = _notebook.markdown(file) if file.suffix == ".ipynb" else file.read_text(encoding="utf-8")
        texts[target] = _outside_code(text, lambda t, path=path: _LINK.sub(lambda m: _link(m, path, where), t))
    for target, text in texts.items():
        (src / target).parent.mkdir(parents=True, exist_ok=True)
        (src / target).write_text(text, encoding="utf-8")
    for file in [*(ROOT / "docs").glob("*.jpg"), *(ROOT / "docs").glob("*.svg"), *(_HERE / "assets").iterdir()]:
        shutil.copy(file, src)
    config = (_HERE / "zensical.toml").read_text(encoding="utf-8").replace("@ROOT@", ROOT.as_posix())
    (folder / "zensical.toml").write_text(config, encoding="utf-8")
    return src


def build(folder: Path) -> Path:
    """Stage and build into `folder`/site, and return that.

    Raises
    ------
    BuildError
        zensical failed, or warned, as of a link that leads nowhere; with what it printed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stage(folder)
    shutil.rmtree(folder / "site", ignore_errors=True)
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    ours = [str(ROOT / folder) for folder in ("", "schemas", "workers")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([*ours, os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, encoding="utf-8")
    if done.returncode:
        raise BuildError(re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr))
    return folder / "site"


def _outside_code(text: str, change: Callable[[str], str]) -> str:
    return "".join(part if part.startswith("```") else change(part) for part in _FENCE.split(text))


def _link(match: re.Match[str], page: str, where: dict[str, str]) -> str:
    picture, shown, target = match.groups()
    path, hash_, anchor = target.partition("#")
    if "://" in target or not path:
        return match[0]
    full = posixpath.normpath(posixpath.join(posixpath.dirname(page), path))
    if full in where:
        to = where[full]
    elif full.startswith("docs/") and (ROOT / full).is_file():  # a picture
        to = full.removeprefix("docs/")
    else:
        return f"`{full}`" if shown.strip("`") == path else f"{shown} (`{full}`)"
    return f"{picture}[{shown}]({posixpath.relpath(to, posixpath.dirname(where[page]) or '.')}{hash_}{anchor})"
