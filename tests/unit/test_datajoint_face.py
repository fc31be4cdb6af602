"""What `pbl_schemas` and `pbl_workers` take from DataJoint beyond its public face, which the installed version has."""

import ast
import inspect
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from datajoint import adapters, autopopulate, connection, diagram, heading, jobs, storage, table, user_tables

from pbl_schemas.datajoint_setup import MySQLOrMariaDB, columns_read_once, datajoint
from tests.source import PACKAGES, ROOT, files, nodes

FACE = PACKAGES["pbl_schemas"] / "pbl_schemas" / "datajoint_setup.py"


def _parameters(function: object) -> list[str]:
    assert callable(function)
    return list(inspect.signature(function).parameters)


def _private(tree: Sequence[ast.AST]) -> set[str]:
    """Names with one underscore that are read or written as an attribute."""
    names = {n.attr for n in tree if isinstance(n, ast.Attribute)}
    return {n for n in names if n.startswith("_") and not n.startswith("__")}


def _of_datajoint() -> set[str]:
    """Every private attribute and method of the installed DataJoint."""
    found: set[str] = set()
    for file in Path(datajoint.__file__).parent.rglob("*.py"):
        tree = nodes(file)
        defined = {n.name for n in tree if isinstance(n, (ast.FunctionDef, ast.ClassDef))}
        stored = {n.id for n in tree if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        found |= _private(tree) | {n for n in defined | stored if n.startswith("_") and not n.startswith("__")}
    return found


#: Private name of DataJoint -> what has to hold of it in the installed version.
USED = {
    "_allow_insert": lambda: (
        autopopulate.AutoPopulate._allow_insert is False
        and 'getattr(self, "_allow_insert", True)' in inspect.getsource(table.Table.insert)
    ),
    "_full_path": lambda: _parameters(storage.StorageBackend._full_path) == ["self", "path"],
    "_heading": lambda: (
        user_tables.UserTable._heading is None
        and list(inspect.signature(heading.Heading).parameters)[:2] == ["attribute_specs", "table_info"]
    ),
}


@pytest.mark.parametrize("name", sorted(USED))
def test_the_installed_version_has_the_private_name(name: str):
    assert USED[name]()


def test_every_private_name_in_use_is_listed_above():
    assert _private(nodes(FACE)) == set(USED)


def test_no_other_file_touches_a_private_name():
    private, found = _of_datajoint(), []
    assert {"_config", "_conn", "_populate1", "_full_path"} <= private
    for file in [f for f in files("pbl_schemas", "pbl_workers") if f != FACE]:
        tree = nodes(file)
        own = {n.name for n in tree if isinstance(n, (ast.FunctionDef, ast.ClassDef))}
        own |= {n.attr for n in tree if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)}
        own |= {n.target.id for n in tree if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)}
        for node in tree:
            if not isinstance(node, ast.Attribute) or node.attr not in private:
                continue
            of_self = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            if not (of_self and node.attr in own):
                found.append(f"{file.relative_to(ROOT)}:{node.lineno} {node.attr}")
    assert not found


def test_cascades_read_columns_once_where_they_are_told_to():
    """`Diagram` makes its tables by the name that is replaced; the columns are shared inside of the block alone."""
    assert "from .table import FreeTable" in inspect.getsource(diagram.Diagram._restricted_table)
    server: Any = types.SimpleNamespace(adapter=adapters.get_adapter("mysql"))

    def columns(name: str) -> object:
        return table.FreeTable(server, f"`s`.`{name}`").heading

    with columns_read_once():
        assert columns("a") is (first := columns("a"))
        assert columns("b") is not first
    assert columns("a") is not first
    with columns_read_once():
        assert columns("a") is not first


def test_no_delete_of_ours_asks():
    """DataJoint asks at a terminal before it deletes, which is left on for people; without one it would end us."""
    found = []
    for file in files("pbl_schemas", "pbl_workers"):
        for node in nodes(file):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "delete":
                said = {k.arg: ast.unparse(k.value) for k in node.keywords}
                found += [] if said.get("prompt") == "False" else [f"{file.relative_to(ROOT)}:{node.lineno}"]
    assert not found


def test_the_public_names_that_carry_most_are_there():
    """Not private, but what everything rests on: the registry of adapters, job tables, transactions."""
    assert adapters.ADAPTERS["mysql"] is MySQLOrMariaDB
    assert type(adapters.get_adapter("mysql")) is MySQLOrMariaDB
    assert _parameters(adapters.MySQLAdapter.connect)[:5] == ["self", "host", "port", "user", "password"]
    assert isinstance(inspect.getattr_static(connection.Connection, "transaction"), property)
    for name in ("reserve", "error", "pending", "reserved", "errors"):
        assert hasattr(jobs.Job, name)


def test_the_columns_of_foreign_keys_are_read_in_their_order():
    """MySQL returns them in any order otherwise; `tests/integration/test_mysql.py` compares the tables there."""
    query = MySQLOrMariaDB().load_foreign_keys_sql("'pbl_fit'", "'~%%'")
    assert query.endswith("ORDER BY table_schema, table_name, constraint_name, ordinal_position")
