"""The map of all tables, made from their definitions: `python -m docs_site.table_map > docs/tables.md`."""

from __future__ import annotations

import re
import sys
from typing import Any

from pbl_schemas.chain import references, renamed, tables
from pbl_schemas.datajoint_setup import dj
from pbl_schemas.stages import STAGES, modules

_ORIGIN = ("code_version", "method_hash", "model_sha256", "host", "seconds", "computed")
_KINDS = {dj.Manual: "manual", dj.Lookup: "lookup", dj.Computed: "computed", dj.Part: "part"}
_SHAPES = {"manual": ('["', '"]'), "lookup": ('[/"', '"/]'), "computed": ('(["', '"])')}

#: A natural join pairs every row with every row where two tables have no column in common that tells visits apart.
_JOINS = """\
## Joins

A natural join (`A * B`) pairs rows by the columns that both have. Where these do not tell one visit from another, such as the name of a
method, it pairs **every visit with every other** and raises nothing: `fit.TrialInput * fit.SessionFit` of 4 visits with 2 videos each has 32 rows
instead of 8, and `lab.Subject * gdi.SessionGdi` has each person with the visits of all people. Count the rows (`len(A * B)`).

| rows | tables | safe chain |
|---|---|---|
| know their visit (`session_id`) | @VISIT@ | `T * session.Session * lab.Subject` |
| know their video only | @VIDEO@ | `T * video.Video * session.Session * lab.Subject` |
| two of these | any `A` and `B` | `A * video.Video * B`: a row of each video; two that know their visit: `A * B` |
| of a part | `SessionGdi.Measure`, `GDI.Cycle`, ... | through its table: `gdi.SessionGdi.Measure * gdi.SessionGdi.proj('session_id')` |
| of a person | `lab.Subject` | never without `session.Session` between it and results |

**Deleting results of chosen visits.** DataJoint 2.3.5 cannot delete from a table that is restricted by another query with a restriction:
`(gdi.GDI & (session.Session & {...})).delete()` ends with "Attribute `pbl_session` is not found in query" and deletes nothing
([datajoint_delete.md](datajoint_delete.md)). Restrict by the keys instead, and let results of the whole visit go along:

```python
from pbl_schemas import gdi, session

chosen = gdi.GDI & (session.Session & {"subject": "P001"})
(gdi.GDI & chosen.keys()).delete(part_integrity="cascade", prompt=False)  # without prompt=False it asks first
```

**A drawing of the tables.** `dj.Diagram(gdi.SessionGdi) - 2` draws itself in a notebook; `.make_svg()` and `.save("tables.svg")` need the program Graphviz
(`apt-get install graphviz`, `brew install graphviz`) and `pip install ipython`, which notebooks bring. `.save("tables.mmd")` needs neither: it writes
Mermaid, as the picture above.
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


def mermaid() -> str:
    """The graph of all tables but the parts."""
    lines = ["flowchart TD"]
    everything = tables()
    for stage in STAGES:
        lines.append(f"  subgraph {stage}")
        for name, cls in everything.items():
            if name.startswith(stage + ".") and kind(cls) != "part":
                left, right = _SHAPES[kind(cls)]
                lines.append(f"    {name.replace('.', '_')}{left}{name.split('.')[1]}{right}")
        lines.append("  end")
    edges = set()
    for name, cls in everything.items():
        own = ".".join(name.split(".")[:2])
        for target in references(name, cls):
            of = ".".join(target.split(".")[:2])
            if of != own:
                edges.add(f"  {of.replace('.', '_')} --> {own.replace('.', '_')}")
    return "\n".join([*lines, *sorted(edges)])


def table_map() -> str:
    """The whole page."""
    lines = [
        "# Tables",
        "",
        "Made by `python -m docs_site.table_map > docs/tables.md`; do not edit. Each section is a schema of the",
        "server, `pbl_<section>`. Boxes are filled by people and `pbl ingest`, slanted boxes hold methods, round ones",
        "`pbl populate` computes.",
        "",
        "```mermaid",
        mermaid(),
        "```",
        "",
        "*origin* stands for the columns that say where a computed row comes from: `<prefix>_code_version`,",
        "`_method_hash`, `_model_sha256`, `_host`, `_seconds` (s), `_computed` (UTC).",
        "",
        *joins(),
    ]
    stage = ""
    for name, cls in tables().items():
        if name.split(".")[0] != stage:
            stage = name.split(".")[0]
            lines += ["", f"## {stage}", "", modules()[STAGES.index(stage)].__doc__ or ""]
        lines += ["", f"### {name} ({kind(cls)})", "", *([comment(cls), ""] if comment(cls) else [])]
        refers = ", ".join(_refers_to(name, cls))
        lines += ["| column | type | meaning |", "|---|---|---|"]
        if refers:
            lines.append(f"| *refers to* | | {refers} |")
        origin = [c for c in columns(cls) if c[0].endswith(_ORIGIN) and _is_origin(c[0], cls)]
        for column, type_, text, in_key in columns(cls):
            if column not in {c[0] for c in origin}:
                shown = f"**{column}**" if in_key else column
                lines.append(f"| {shown} | {_cell(type_)} | {_cell(text)} |")
        if origin:
            lines.append("| *origin* | | |")
    return "\n".join(lines) + "\n"


def joins() -> list[str]:
    """Return the section of the joins that give each row its own visit, line by line."""
    computed = {name: cls for name, cls in tables().items() if issubclass(cls, dj.Computed)}
    of_visit = [name for name, cls in computed.items() if "session.Session" in references(name, cls)]
    of_video = [name for name in computed if name not in of_visit]
    text = _JOINS.replace("@VISIT@", _names(of_visit)).replace("@VIDEO@", _names(of_video))
    return text.splitlines()


def _names(found: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in found)


def _refers_to(name: str, cls: Any) -> list[str]:
    """`references`, with the column's name here where it is another: "video.Video as rig_trial"."""
    return [f"{t} as {new}" if new else t for t, new in zip(references(name, cls), renamed(cls), strict=True)]


def _is_origin(column: str, cls: Any) -> bool:
    prefix = origin_prefix(cls)
    return prefix is not None and column.startswith(prefix)


def origin_prefix(cls: Any) -> str | None:
    """Prefix of a table's origin columns, None where it has none."""
    found = [c[0] for c in columns(cls) if c[0].endswith("_code_version")]
    return found[0].removesuffix("code_version") if found else None


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace(">", "&gt;")


if __name__ == "__main__":
    sys.stdout.write(table_map())
