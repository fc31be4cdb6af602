"""The map of all tables, made from their definitions: `python -m docs_site.table_map > docs/tables.md`."""

from __future__ import annotations

import re
import sys
import textwrap
from typing import Any

from pbl_schemas.chain import references, renamed, tables
from pbl_schemas.datajoint_setup import dj
from pbl_schemas.stages import STAGES, modules

_ORIGIN = ("code_version", "method_hash", "model_sha256", "host", "seconds", "computed")
_KINDS = {dj.Manual: "manual", dj.Lookup: "lookup", dj.Computed: "computed", dj.Part: "part"}
#: So many leading columns have to be alike for a table to be described by another one.
_LEAST_ALIKE = 4
#: Longer names of columns do not widen the others'.
_WIDEST = 40

_START = """\
# Tables

Each section is a schema of the server, `pbl_<section>`, in the order of computing. *Manual* tables are filled by people and
`pbl ingest`, *lookup* tables hold methods and terms, `pbl populate` fills *computed* ones. The primary key stands above `---`; `->` is a
foreign key, whose columns the table also has; a part has the key of its table. *origin* stands for the columns that state where a computed
row comes from: `<prefix>_code_version`, `_method_hash`, `_model_sha256`, `_host`, `_seconds` (s), `_computed` (UTC).

Made by `python -m docs_site.table_map > docs/tables.md`; do not edit.
"""  # noqa: E501

#: A natural join pairs every row with every row where two tables have no column in common that tells visits apart.
_JOINS = """\
## Joins

A natural join (`A * B`) pairs rows by their common columns. If these do not tell one visit from another, such as the name of a method,
it pairs **every visit with every other** and raises nothing: `lab.Subject * gdi.SessionGdi` has each person with the visits of all people. Count the
rows (`len(A * B)`).

| rows | tables | safe chain |
|---|---|---|
| know their visit (`session_id`) | @VISIT@ | `T * session.Session * lab.Subject` |
| know their video only | @VIDEO@ | `T * video.Video * session.Session * lab.Subject` |
| two of these | any `A` and `B` | `A * video.Video * B`: a row of each video; two that know their visit: `A * B` |
| of a part | `SessionGdi.Measure`, `GDI.Cycle`, ... | through its table: `gdi.SessionGdi.Measure * gdi.SessionGdi.proj('session_id')` |
| of a person | `lab.Subject` | never without `session.Session` between it and results |

**Deleting results of chosen visits.** DataJoint 2.3.5 cannot delete from a table restricted by a query that is itself restricted: "Attribute `pbl_session` is
not found in query" ([cause](../research/reports/2026-11-29_datajoint_delete.md)). Restrict by the keys instead, and let results of the whole visit go along:

```python
from pbl_schemas import gdi, session

chosen = gdi.GDI & (session.Session & {"subject": "P001"})
(gdi.GDI & chosen.keys()).delete(part_integrity="cascade", prompt=False)  # without prompt=False it asks first
```

**A drawing of the tables.** `dj.Diagram(gdi.SessionGdi) - 2` in a notebook; `.save("tables.svg")` needs Graphviz and `pip install ipython`,
`.save("tables.mmd")` writes Mermaid and needs neither.
"""  # noqa: E501


def kind(cls: Any) -> str:
    """manual, lookup, computed or part."""
    return next(word for base, word in _KINDS.items() if issubclass(cls, base))


def columns(cls: Any) -> list[tuple[str, str, str, bool]]:
    """(name, type, comment, in the key) of each column a definition states itself."""
    out, in_key = [], True
    for line in cls.definition.splitlines():
        text = line.strip()
        if text.startswith("---"):
            in_key = False
        match = re.match(r"(\w+)\s*(=\s*[^:]+?)?\s*:\s*([^#]+?)\s*(?:#\s*(.*))?$", text)
        if match and not text.startswith(("#", "->")) and not re.match(r"(unique\s+)?index\s*\(", text):
            out.append((match.group(1), match.group(3), match.group(4) or "", in_key))
    return out


def comment(cls: Any) -> str:
    """The first comment of a definition: what a row is."""
    for line in cls.definition.splitlines():
        if line.strip().startswith("#"):
            return line.strip().lstrip("# ")
    return ""


def table_map() -> str:
    """The whole page."""
    lines = [*_START.splitlines(), "", *joins()]
    stage, written = "", {}
    for name, cls in tables().items():
        if name.split(".")[0] != stage:
            stage = name.split(".")[0]
            lines += ["", f"## {stage}", "", modules()[STAGES.index(stage)].__doc__ or ""]
        lines += ["", f"### {name} ({kind(cls)})", "", *([comment(cls), ""] if comment(cls) else [])]
        lines += ["```text", *_listed(name, cls, written), "```"]
    return "\n".join(lines) + "\n"


def _listed(name: str, cls: Any, written: dict[str, list[tuple[str, str]]]) -> list[str]:
    """The lines of a definition: alike columns in one, those that a table before has as well by their names only."""
    own = [c for c in columns(cls) if not _is_origin(c[0], cls)]
    alike, n = _alike(own, written)
    written[name] = _without_key(own)
    rows = [(", ".join(c[0] for c in own[:n]), f"as in {alike}, in this order", "", True)] if n else []
    for column, type_, text, in_key in own[n:]:
        said = (type_.replace("', '", "','"), text, in_key)
        if rows and rows[-1][1:] == said:
            rows[-1] = (f"{rows[-1][0]}, {column}", *said)
        else:
            rows.append((column, *said))
    if origin_prefix(cls):
        rows.append(("origin", "", "", False))
    keys, others = ([row[:3] for row in rows if row[3] is key] for key in (True, False))
    of_key, of_row = _refers_to(name, cls)
    wide = max([len(row[0]) for row in rows if len(row[0]) <= _WIDEST] or [0])
    lines = [*of_key, *(line for row in keys for line in _line(row, wide))]
    below = [*of_row, *(line for row in others for line in _line(row, wide))]
    return [*lines, "---", *below] if lines and below else lines + below


def _line(row: tuple[str, str, str], wide: int) -> list[str]:
    """A column with its type and meaning, broken below its name."""
    text = f"{row[0]:<{wide}}  {row[1]:<14}  {row[2]}".rstrip()
    below = " " * (2 + wide * (len(row[0]) <= wide))
    return textwrap.wrap(text, 130, subsequent_indent=below, break_long_words=False, break_on_hyphens=False)


def _alike(own: list[tuple[str, str, str, bool]], written: dict[str, list[tuple[str, str]]]) -> tuple[str, int]:
    """The first table with the most leading columns of the same types and meanings, and their number."""
    best, most = "", 0
    for name, theirs in written.items():
        n = next((i for i, (a, b) in enumerate(zip(_without_key(own), theirs, strict=False)) if a != b), None)
        n = min(len(own), len(theirs)) if n is None else n
        if n > most and n == len(theirs):
            best, most = name, n
    return (best, most) if most >= _LEAST_ALIKE else ("", 0)


def _without_key(own: list[tuple[str, str, str, bool]]) -> list[tuple[str, str]]:
    """Types and meanings, without the name of the first column in them."""
    return [(type_, text.replace(f"(see {own[0][0]})", "(see the name)")) for _, type_, text, _ in own]


def joins() -> list[str]:
    """Return the section of the joins that give each row its own visit, line by line."""
    computed = {name: cls for name, cls in tables().items() if issubclass(cls, dj.Computed)}
    of_visit = [name for name, cls in computed.items() if "session.Session" in references(name, cls)]
    of_video = [name for name in computed if name not in of_visit]
    text = _JOINS.replace("@VISIT@", _names(of_visit)).replace("@VIDEO@", _names(of_video))
    return text.splitlines()


def _names(found: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in found)


def _refers_to(name: str, cls: Any) -> tuple[list[str], list[str]]:
    """Foreign keys in the primary key and beside it: "-> video.Video as rig_trial"; not a part's own table."""
    found, in_key, master = ([], []), True, name.rpartition(".")[0]
    names = iter(zip(references(name, cls), renamed(cls), strict=True))
    for line in map(str.strip, cls.definition.splitlines()):
        in_key &= not line.startswith("---")
        if line.startswith("->"):
            table, new = next(names)
            if table != master:
                found[not in_key].append(f"-> {table} as {new}" if new else f"-> {table}")
    return found


def _is_origin(column: str, cls: Any) -> bool:
    prefix = origin_prefix(cls)
    return prefix is not None and column in {prefix + c for c in _ORIGIN}


def origin_prefix(cls: Any) -> str | None:
    """Prefix of a table's origin columns, None where it has none."""
    found = [c[0] for c in columns(cls) if c[0].endswith("_code_version")]
    return found[0].removesuffix("code_version") if found else None


if __name__ == "__main__":
    sys.stdout.write(table_map())
