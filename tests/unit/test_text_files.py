"""Every text file is opened as UTF-8: Windows would take the encoding of its language.

Ruff's rule for this (PLW1514) is in preview and sees a path only where its type is written beside the call.
"""

import ast
from collections.abc import Iterable

import pytest

from tests.source import PACKAGES, ROOT, files, nodes


def without_encoding(source: Iterable[ast.AST]) -> list[int]:
    """Lines with a call that opens a text file in the encoding of the system."""
    return [node.lineno for node in source if isinstance(node, ast.Call) and _is_text(node)]


def _is_text(call: ast.Call) -> bool:
    if any(k.arg == "encoding" for k in call.keywords):
        return False
    named = [k.value for k in call.keywords if k.arg == "mode"]
    match call.func:
        case ast.Attribute(ast.Name("av" | "archive" | "bounded")):  # a video, a member of a zip file, our own reader
            return False
        case ast.Attribute(_, "read_text"):
            return not call.args
        case ast.Attribute(_, "write_text"):
            return len(call.args) == 1
        case ast.Attribute(ast.Name("os"), "fdopen") | ast.Name("open"):
            mode = [*named, *call.args[1:2], ast.Constant("r")][0]
        case ast.Attribute(_, "open"):
            mode = [*named, *call.args[:1], ast.Constant("r")][0]
        case _:
            return False
    return isinstance(mode, ast.Constant) and mode.value in ("r", "w", "a", "x", "r+", "w+")


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("path.read_text()", True),
        ("path.read_text(encoding='utf-8')", False),
        ("(folder / 'a').write_text(lines)", True),
        ("path.open()", True),
        ("path.open('rb')", False),
        ("path.open('w')", True),
        ("open(path)", True),
        ("open(path, 'rb')", False),
        ("open(path, mode='w')", True),
        ("os.fdopen(handle, 'w')", True),
        ("os.fdopen(handle, 'wb')", False),
        ("av.open(path, 'w')", False),
        ("read_text(path)", False),
    ],
)
def test_calls_are_told_apart(source, text):
    assert bool(without_encoding(ast.walk(ast.parse(source)))) is text


def test_text_files_are_opened_as_utf_8():
    ours = files(*PACKAGES)
    assert len(ours) > 300
    found = [f"{f.relative_to(ROOT)}:{n}" for f in ours for n in without_encoding(nodes(f))]
    assert not found
