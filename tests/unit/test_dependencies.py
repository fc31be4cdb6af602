"""One direction of dependency: pbl_pipeline <- schemas <- workers; nothing in the wheel imports research or tests."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

# In a fresh process, so that nothing another test imported counts. `None` in sys.modules makes an import fail.
BLOCKED = """
import importlib, pkgutil, sys
for name in ("datajoint", "schemas", "workers"):
    sys.modules[name] = None
import pbl_pipeline
def fail(name):
    raise
names = [m.name for m in pkgutil.walk_packages(pbl_pipeline.__path__, "pbl_pipeline.", onerror=fail)]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
print(len(names))
"""


@pytest.mark.slow
def test_the_library_imports_with_the_tables_blocked():
    done = subprocess.run([sys.executable, "-c", BLOCKED], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    assert int(done.stdout.split()[-1]) > 40


LIGHT = """
import sys
import schemas
from schemas._activate import modules
modules()
print(*(name for name in ("jax", "mujoco", "cv2", "scipy", "onnxruntime", "ai_edge_litert") if name in sys.modules))
"""


@pytest.mark.slow
def test_importing_the_tables_loads_no_numerical_library():
    """Commands that only look at rows answer at once: the library is imported inside the functions that compute."""
    done = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split() == []


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("pbl_pipeline", {"schemas", "workers", "research", "tests", "datajoint", "pymysql"}),
        ("schemas", {"workers", "research", "tests"}),
        ("workers", {"research", "tests"}),
        ("research", {"schemas", "workers", "datajoint", "tests"}),
    ],
)
def test_no_import_against_the_direction(package: str, forbidden: set[str]):
    # The benchmarks alone also measure tables and workers, on the databases that the tests make.
    files = [f for f in sorted((ROOT / package).rglob("*.py")) if f.parent != ROOT / "research" / "benchmarks"]
    assert len(files) > 5
    found = [f"{f.relative_to(ROOT)}: {name}" for f in files for name in _imports(f) if name.split(".")[0] in forbidden]
    assert not found


@functools.cache
def _rooms() -> dict[str, dict[str, set[str]]]:
    """Room -> room that it imports -> modules imported there. A room is a package's own folder, without its
    subpackages; a module beside the packages (`pbl_pipeline/errors.py`) is a room of its own. All imports count:
    those inside functions and those for types alone, too."""
    files = sorted((ROOT / "pbl_pipeline").rglob("*.py"))
    module_of = {f: ".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for f in files}
    room_of = {
        name: name if file.name == "__init__.py" or file.parent.name == "pbl_pipeline" else name.rsplit(".", 1)[0]
        for file, name in module_of.items()
    }
    found: dict[str, dict[str, set[str]]] = {room: {} for room in set(room_of.values())}
    for file, name in module_of.items():
        package = name if file.name == "__init__.py" else name.rsplit(".", 1)[0]
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = package.rsplit(".", node.level - 1)[0] if node.level else ""
                base = ".".join(part for part in (base, node.module) if part)
                targets = [full if (full := f"{base}.{a.name}") in room_of else base for a in node.names]
            else:
                continue
            for target in targets:
                if target in room_of and room_of[target] != room_of[name]:
                    found[room_of[name]].setdefault(room_of[target], set()).add(target)
    return found


def test_the_rooms_of_the_library_import_each_other_in_one_direction():
    """No circle, and a package stands above its subpackages: types below, dispatch above."""
    below = {room: set(into) for room, into in _rooms().items()}
    assert len(below) > 20
    while True:  # take away, again and again, the rooms that import none of those that are left
        free = {room for room, into in below.items() if not into & below.keys()}
        if not free:
            break
        below = {room: into for room, into in below.items() if room not in free}
    assert not {room: sorted(into & below.keys()) for room, into in below.items()}


def test_a_private_module_is_used_in_its_own_folder_only():
    """`package/_module.py` is for `package/*.py`: other packages, parents and children use the public face."""
    found = {
        f"{room} imports {module}"
        for room, into in _rooms().items()
        for target, modules in into.items()
        for module in modules
        if module.rsplit(".", 1)[-1].startswith("_")
    }
    assert not found


def _imports(file: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module":
            names |= {a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)}
    return names


def test_datajoint_is_configured_before_it_is_imported():
    """A datajoint.json in the working directory must never count, so only one file may import DataJoint itself."""
    allowed = {"schemas/_datajoint.py"}
    files = [f for package in ("schemas", "workers") for f in (ROOT / package).rglob("*.py")]
    found = {str(f.relative_to(ROOT)) for f in files if any(n.split(".")[0] == "datajoint" for n in _imports(f))}
    assert found == allowed
