"""Codes of errors: each is declared by the package that raises it, and a laboratory adds its own."""

import ast
import pickle

import pytest

from pbl_pipeline.errors import CODES, INPUT, MACHINE, Code, PblError, register
from tests.source import PACKAGES, files, nodes

#: Printed before anything is imported.
BEFORE_IMPORTS = {"PYTHON_UNSUPPORTED"}


def _declared(package: str) -> set[str]:
    source = PACKAGES[package] / package / "errors.py"
    tables = [node for node in nodes(source) if isinstance(node, ast.Dict)]
    return {str(k.value) for t in tables for k in t.keys if isinstance(k, ast.Constant) and str(k.value).isupper()}


def _written(*packages: str) -> set[str]:
    own = [file for file in files(*packages) if file.name != "errors.py"]
    return {str(n.value) for f in own for n in nodes(f) if isinstance(n, ast.Constant)}


def test_a_code_is_declared_by_the_lowest_package_that_uses_it():
    library, tables, workers = (_declared(package) for package in PACKAGES)
    assert min(len(library), len(tables), len(workers)) > 5
    assert not (tables | workers) & _written("pbl_pipeline")
    assert not workers & _written("pbl_schemas")
    assert library - _written("pbl_pipeline") <= BEFORE_IMPORTS
    assert tables <= _written("pbl_schemas")


def test_a_laboratory_registers_its_own_code():
    with pytest.raises(ValueError, match="register"):
        PblError("PLATE_SATURATED", "6.2 kN", "at most 5 kN", "record again")
    register({"PLATE_SATURATED": Code(INPUT, "a force plate was overloaded")})
    error = pickle.loads(pickle.dumps(PblError("PLATE_SATURATED", "6.2 kN", "at most 5 kN", "record again")))
    assert error.final
    assert error.text().startswith("PLATE_SATURATED: a force plate was overloaded\n  found:    6.2 kN")
    register({"PLATE_SATURATED": Code(INPUT, "a force plate was overloaded")})  # the module is imported again
    with pytest.raises(ValueError, match="another meaning: PLATE_SATURATED"):
        register({"PLATE_SATURATED": Code(MACHINE, "a plate")})
    del CODES["PLATE_SATURATED"]
