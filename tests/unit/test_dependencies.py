"""One direction of dependency: pbl_pipeline <- pbl_schemas <- pbl_workers; the wheel imports no research, no tests."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

from tests.source import PACKAGES, ROOT, files, module_name, nodes

# In a fresh process, so that nothing another test imported counts. `None` in sys.modules makes an import fail.
BLOCKED = """
import importlib, pkgutil, sys
for name in ("datajoint", "pbl_schemas", "pbl_workers"):
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
import pbl_schemas
from pbl_schemas.stages import modules
modules()
print(*(name for name in ("jax", "mujoco", "cv2", "scipy", "onnxruntime", "ai_edge_litert") if name in sys.modules))
"""


@pytest.mark.slow
def test_importing_the_tables_loads_no_numerical_library():
    """Commands that only look at rows answer at once: the library is imported inside the functions that compute."""
    done = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split() == []


@pytest.mark.slow
def test_a_recording_does_not_wait_for_what_only_tables_need():
    code = "import sys, pbl_pipeline.pipeline; print(*({'pandas', 'scipy.stats', 'scipy.signal'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.split() == []


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [
        ("pbl_pipeline", {"pbl_schemas", "pbl_workers", "research", "tests", "datajoint", "pymysql"}),
        ("pbl_schemas", {"pbl_workers", "research", "tests"}),
        ("pbl_workers", {"research", "tests"}),
        ("research", {"pbl_schemas", "pbl_workers", "datajoint", "tests"}),
    ],
)
def test_no_import_against_the_direction(package: str, forbidden: set[str]):
    # The benchmarks also measure tables and workers, on the databases that the tests make; tests use other tests.
    research = ROOT / "research"
    ours = [f for f in files(package) if f.parent not in (research / "benchmarks", research / "tests")]
    assert len(ours) > 5
    found = [f"{f.relative_to(ROOT)}: {name}" for f in ours for name in _imports(f) if name.split(".")[0] in forbidden]
    assert not found


@functools.cache
def _modules(package: str) -> dict[str, set[str]]:
    """Module of a package -> modules of it that are imported there, also inside functions, for types alone and by
    `importlib` with a written name."""
    module_of = {f: module_name(f) for f in files(package)}
    known = set(module_of.values())
    found: dict[str, set[str]] = {}
    for file, name in module_of.items():
        within = name if file.name == "__init__.py" else name.rsplit(".", 1)[0]
        targets: set[str] = set()
        for node in nodes(file):
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                base = within.rsplit(".", node.level - 1)[0] if node.level else ""
                base = ".".join(part for part in (base, node.module) if part)
                targets |= {full if (full := f"{base}.{a.name}") in known else base for a in node.names}
            elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
                targets |= {str(a.value) for a in node.args if isinstance(a, ast.Constant)}
                ahead = [
                    str(a.values[0].value)
                    for a in node.args
                    if isinstance(a, ast.JoinedStr) and isinstance(a.values[0], ast.Constant)
                ]
                targets |= {m for m in known for start in ahead if start.count(".") > 1 and m.startswith(start)}
                # `import_module(f"package.{name}")`: the names of a constant of the file
                targets |= {start + text for start in ahead for text in _texts(file)}
        found[name] = (targets & known) - {name}
    return found


@functools.cache
def _texts(file: Path) -> frozenset[str]:
    """The texts of the file's constant tuples."""
    tuples = [n.value for n in nodes(file) if isinstance(n, ast.Assign) and isinstance(n.value, ast.Tuple)]
    return frozenset(str(e.value) for t in tuples for e in t.elts if isinstance(e, ast.Constant))


def _in_circles(imports: dict[str, set[str]]) -> dict[str, list[str]]:
    """The modules that remain when those are removed, again and again, that import none of the others or that none of
    them imports."""
    left = imports
    while True:
        used = {target for targets in left.values() for target in targets}
        kept = {name for name, targets in left.items() if targets & left.keys() and name in used}
        if len(kept) == len(left):
            return {name: sorted(targets) for name, targets in sorted(left.items())}
        left = {name: left[name] & kept for name in kept}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_module_imports_one_that_imports_it(package: str):
    """Types below, methods above: no circle of imports, however long and wherever in a module they stand."""
    imports = _modules(package)
    assert len(imports) > 20
    assert _in_circles(imports) == {}


def test_a_circle_is_found():
    chain = {"a": {"b"}, "b": {"c"}, "c": set(), "d": {"a"}}
    assert _in_circles(chain) == {}
    assert _in_circles({**chain, "c": {"b"}}) == {"b": ["c"], "c": ["b"]}
    assert _in_circles({**chain, "c": {"a"}}) == {"a": ["b"], "b": ["c"], "c": ["a"]}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_module_puts_something_into_another(package: str):
    """`module.Class.name = ...` from outside is an import against the direction that no import shows."""
    found = [f"{module_name(f)}: {text}" for f in files(package) for text in _put_in(ast.parse(f.read_text("utf-8")))]
    assert not found


def _put_in(tree: ast.Module) -> list[str]:
    """Assignments to attributes of what was imported from our packages (not to DataJoint's settings)."""
    imported: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.level or str(node.module).startswith("pbl_")):
            imported |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            imported |= {alias.asname or "" for alias in node.names if alias.name.startswith("pbl_")}
    found = []
    for node in ast.walk(tree):
        targets: list[ast.expr] = []
        if isinstance(node, ast.Assign):
            targets = [t for t in node.targets if isinstance(t, ast.Attribute)]
        elif isinstance(node, ast.AugAssign | ast.AnnAssign) and isinstance(node.target, ast.Attribute):
            targets = [node.target]
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "setattr":
            targets = [node.args[0]]
        roots = {ast.unparse(t).partition(".")[0] for t in targets}
        found += [ast.unparse(node)] if roots & (imported - {"dj"}) else []
    return found


@pytest.mark.parametrize(
    ("code", "count"),
    [
        ("from . import fit\nfit.SessionFit.plan = staticmethod(len)", 1),
        ("from .fit import SessionFit\nsetattr(SessionFit, 'plan', len)", 1),
        ("import pbl_schemas.fit as fit\nfit.COUNT += 1", 1),
        ("from . import fit\nfound = fit.COUNT\nfound.plan = 1", 0),
    ],
)
def test_an_assignment_from_outside_is_found(code: str, count: int):
    assert len(_put_in(ast.parse(code))) == count


@functools.cache
def _rooms() -> dict[str, dict[str, set[str]]]:
    """Room -> room that it imports -> modules imported there. A room is a package's own folder, without its
    subpackages; a module beside the packages (`pbl_pipeline/errors.py`) is a room of its own."""
    imports = _modules("pbl_pipeline")
    packages = {name for name in imports if (ROOT / Path(*name.split(".")) / "__init__.py").is_file()}

    def room_of(name: str) -> str:
        return name if name in packages or name.count(".") == 1 else name.rsplit(".", 1)[0]

    found: dict[str, dict[str, set[str]]] = {room_of(name): {} for name in imports}
    for name, targets in imports.items():
        for target in targets:
            if room_of(target) != room_of(name):
                found[room_of(name)].setdefault(room_of(target), set()).add(target)
    return found


def test_the_rooms_of_the_library_import_each_other_in_one_direction():
    """No circle, and a package stands above its subpackages: types below, dispatch above."""
    below = {room: set(into) for room, into in _rooms().items()}
    assert len(below) > 20
    assert _in_circles(below) == {}


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
    for node in nodes(file):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module":
            names |= {a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)}
    return names


def test_datajoint_is_configured_before_it_is_imported():
    """A datajoint.json in the working directory must never count, so only one file may import DataJoint itself."""
    allowed = {"schemas/pbl_schemas/datajoint_setup.py"}
    found = {
        str(f.relative_to(ROOT))
        for f in files("pbl_schemas", "pbl_workers")
        if any(n.split(".")[0] == "datajoint" for n in _imports(f))
    }
    assert found == allowed


# --- Every module of the tables can be the first that a command imports.


_FIRST = """
import importlib, pathlib, sys
import pbl_schemas.reading, pbl_workers.web
for package in (pbl_schemas, pbl_workers):
    root = pathlib.Path(package.__file__).parents[1]
    for file in sorted((root / package.__name__).rglob("*.py")):
        name = ".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        if not file.stem[:1].isdigit():
            for loaded in [n for n in sys.modules if n.partition(".")[0] in ("pbl_schemas", "pbl_workers")]:
                del sys.modules[loaded]
            try:
                importlib.import_module(name)
            except ImportError as error:
                print(name, error)
"""


@pytest.mark.slow
def test_no_module_needs_another_to_be_imported_before_it():
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _FIRST], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr[-1000:]
