"""Every call of `pbl` that the documentation shows is one that `pbl` takes."""

from __future__ import annotations

from collections.abc import Sequence

import click
import pytest

from docs_site import commands
from tests import pages

TREE = dict(commands.tree())
#: Groups that are a command of theirs where none is named.
DEFAULT = {"pbl validate": "pbl validate tables"}
#: Words that stand for any command.
ANY = {"COMMAND"}


def wrong(words: Sequence[str], *, whole: bool) -> str:
    """What `pbl` would say of a call, "" where it takes it. Not `whole`: options may stand without their value."""
    name, rest = "pbl", list(words)
    while rest and f"{name} {rest[0]}" in TREE:
        name = f"{name} {rest.pop(0)}"
    if rest or whole:
        name = DEFAULT.get(name, name)
    ctx = TREE[name]
    if name == "pbl" and rest and rest[0] in ANY:
        return ""
    try:
        found, extra, _ = ctx.command.make_parser(ctx).parse_args(rest)
        if extra:
            return f"{name}: {extra}?"
        if whole:
            for param in ctx.command.params:
                value = found.get(param.name or "")
                missing = value is None or value == () or type(value).__name__ == "Sentinel"
                if not missing:
                    if isinstance(param.type, click.Choice):
                        param.type_cast_value(ctx, value)
                elif param.required:
                    return f"{name}: {param.name} is missing"
    except click.BadOptionUsage as error:
        return str(error) if whole else ""
    except click.UsageError as error:
        return error.format_message()
    return ""


@pytest.mark.parametrize("page", pages.pages())
def test_the_commands_of_a_page(page: str):
    blocks = [c for b in pages.blocks(page) if b.language in ("", "sh", "text") for c in pages.commands(b.code)]
    found = {" ".join(c): wrong(c, whole=True) for c in blocks}
    found |= {" ".join(c): wrong(c, whole=False) for c in pages.commands_in_prose(page)}
    assert {call: why for call, why in found.items() if why} == {}


def test_the_examples_of_the_help():
    found = {}
    for ctx in TREE.values():
        ctx.terminal_width = 1000  # no line is broken
        found |= {" ".join(c): wrong(c, whole=True) for c in pages.commands(ctx.get_help())}
    assert len(found) > 60
    assert {call: why for call, why in found.items() if why} == {}


@pytest.mark.parametrize(
    "call",
    [
        "run --outt results walk.mp4",
        "runn walk.mp4",
        "run",
        "run walk.mp4 --out",
        "db begin",
        "db init now",
        "deidentify walk.mp4 --how paint",
    ],
)
def test_a_wrong_call_is_seen(call: str):
    assert wrong(call.split(), whole=True)
