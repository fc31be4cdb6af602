"""The package on another Python of this machine: `python -m tests.other_python [PYTHON ...]`, `make test-newest`.

For each interpreter (none named: the newest one beside that of this environment): an empty environment, the wheel of
this checkout with the newest versions that its bounds allow, `pbl demo --no-database`, whose measures are those of this
environment, then the fast tests. Ends with 1 if anything of this fails; says so and ends with 0 where there is no other
Python.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.source import ROOT

FOLDER = ROOT / "build" / "other-python"
FAST = "not slow and not database and not browser and not needs_extra"
#: Largest difference of a measure, in its unit and as a fraction.
TOLERANCE = 1e-3


def newest() -> list[str]:
    """Return the newest supported interpreter beside the version of this one, which can make an environment."""
    pattern = re.compile(r"python3\.(\d+)")
    folders = [*os.environ.get("PATH", os.defpath).split(os.pathsep), *Path.home().glob(".pyenv/versions/*/bin")]
    programs = {p for folder in folders for p in Path(folder).glob("python3.*") if pattern.fullmatch(p.name)}
    for program in sorted(programs, key=lambda p: -int(p.name.partition(".")[2])):
        minor = int(program.name.partition(".")[2])
        if minor >= 11 and minor != sys.version_info.minor and _runs(str(program), "-c", "import ensurepip, venv"):
            return [str(program)]
    return []


def check(python: str) -> list[str]:
    """Install, run and test on one interpreter; return what failed."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    _run(sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(FOLDER))
    (wheel,) = FOLDER.glob("*.whl")
    program = FOLDER / "env" / "bin" / "python"
    install = [str(program), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"]
    with subprocess.Popen(_demo(Path(sys.executable)), cwd=FOLDER, env=_environment()) as of_this:  # while pip works
        _run(python, "-m", "venv", str(FOLDER / "env"))
        _run(*install, str(wheel))
        of_the_other = subprocess.run(_demo(program), cwd=FOLDER, env=_environment(), check=False)
    if of_this.returncode or of_the_other.returncode:
        return ["the demo"]
    here, there = (_measures(_out(p)) for p in (Path(sys.executable), program))
    other = [name for name in here.keys() | there.keys() if not _alike(here.get(name), there.get(name))]
    failed = [f"measures of the demo: {', '.join(sorted(other))}"] if other else []
    print(f"{len(here)} measures of the demo are equal within {TOLERANCE:g}" if not other else failed[0], flush=True)
    _run(*install, "--editable", f"{ROOT}[dev]")
    tests = [str(program), "-m", "pytest", "-p", "no:cacheprovider", "--numprocesses", "2", "--dist", "loadfile"]
    if subprocess.run([*tests, "-m", FAST, "tests"], cwd=ROOT, env=_environment(), check=False).returncode:
        failed.append("the fast tests")
    return failed


def _out(program: Path) -> Path:
    return FOLDER / f"demo-{'here' if program == Path(sys.executable) else 'there'}"


def _demo(program: Path) -> list[str]:
    return [str(program.with_name("pbl")), "--quiet", "demo", "--no-database", "--out", str(_out(program))]


def _environment() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")}


def _measures(out: Path) -> dict[str, Any]:
    return dict(_leaves(json.loads((out / "metrics.json").read_text(encoding="utf-8"))))


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and value.get("check") == "iterations":
        return  # no measure: rounding decides whether the solver takes one step more
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{name}.{key}".strip("."))
    else:
        yield name, value


def _alike(a: Any, b: Any) -> bool:
    if isinstance(a, float) and isinstance(b, float | int):
        return math.isclose(a, b, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
    return isinstance(a, str) or a == b  # texts hold numbers in words, such as those of checks


def _runs(*words: str) -> bool:
    return subprocess.run(words, capture_output=True, check=False, cwd=FOLDER.anchor).returncode == 0


def _run(*words: str) -> None:
    subprocess.run(words, cwd=ROOT, env=_environment(), check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    pythons = sys.argv[1:] or newest()
    if not pythons:
        print("no other Python on this machine: the package was tested on this one only")
    problems = {}
    for one in pythons:
        version = subprocess.run([one, "--version"], capture_output=True, text=True, check=True).stdout.strip()
        print(f"{version} ({one})", flush=True)
        problems[version] = check(one)
        print(f"{version}: {'; '.join(problems[version]) or 'passed'}", flush=True)
    sys.exit(any(problems.values()))
