"""The map of all tables, made from their definitions: `python -m docs_site.table_map > docs/tables.md`."""

from __future__ import annotations

import itertools
import re
import sys
import textwrap
from typing import Any

from pbl_schemas.chain import references, renamed, tables
from pbl_schemas.datajoint_setup import dj
from pbl_schemas.stages import STAGES, modules

_ORIGIN = ("code_version", "method_hash", "model_sha256", "host", "seconds", "computed")
#: A column as `columns` returns it: name, type, comment, in the key.
_Column = tuple[str, str, str, bool]
#: Prefix of a visit's columns, where a trial has the same ones without it.
_VISIT = "session_"
_KINDS = {dj.Manual: "", dj.Lookup: " (lookup)", dj.Computed: " (computed)", dj.Part: ""}
#: Columns of a method and of a check after their prefix: they stand at the top of the page, each table has the word.
_GROUPS = {
    "method": ("_method", "_method_name", "_method_version", "_params", "_method_sha"),
    "check": ("_check", "_check_outcome", "_check_value", "_check_threshold", "_check_advice"),
}
#: Meanings of columns by their ending, which the top of the page states for all.
_SAID = {
    "_created": ("when registered", "when planned", "when decided", "when"),
    "_by": ("name of who decided", "name of who corrected", "name of who decided, as the page knows it"),
    "_at": ("when",),
    "_sha256": ("of its bytes", "of the copy's bytes", "of the file's bytes", "of the bytes of the copy"),
    "_size": ("(byte) length", "(byte) length of the file", "(byte) length of the copy"),
    "_reason": ("why EMPTY",),
    "_missing": ("why it is null",),
    "_file": ("the file",),
    "_check": ("name, with its unit",),
    "measure": ("name, with its unit",),
}
#: Endings and words of a meaning that the top of the page states for all tables.
_SHORTER = {
    r"[,;] (null|empty) (when|where|if) (it was )?(not known|unknown|not estimated|not recorded)$": "",
    r"[,;] null: not known$": "",
    r"standard deviation\b": "sd",
    r"(, |^)clock of the database server$": "",
    r"in the unit \(see \w*(check|measure)\)": "(unit)",
    r"in the unit \(see ([\w.]+)\)": r"(\1)",
}
#: Types that a reader asks the server for.
_PLAIN = re.compile(r"bool|float64|(var)?char\(\d+\)|int\d+|datetime(\(3\))?|date")
#: So many consecutive columns have to be alike to be described by those of another table.
_LEAST_ALIKE = 4
#: Longer names of columns do not widen the others'.
_WIDEST = 40

_START = """\
# Tables

Each section is a schema of the server, `pbl_<section>`, in the order of computing. `pbl populate` fills *computed* tables, people and `pbl ingest`
those without a word; *lookup* tables hold terms. Keys stand above `---`. `->` is a foreign key, whose columns the table also has. `A.B.C` is a part of
`A.B` and has its key. *as in* a table: the same columns without `session_`.

`T.heading` of a table T prints all types. `sd` is a standard deviation.
Terms, json and files (`<object@arrays>`: [formats](files.md)) state their type, a column with a unit in brackets is float64 (*unit*: that in the
name of the check or measure). Times are in UTC, by the server's clock. Unless stated, null means not known, `_created` when the row was
made, `_by` who decided, by name, `_sha256` that of the file, `_size` its length (byte), `_reason` why EMPTY, and `_missing` why it is null. Words that
stand for columns with a prefix:

- *origin*, where a row of each computed table comes from: `_code_version`, `_method_hash`, `_model_sha256`, `_host`, `_seconds` (s), `_computed`
- *method*: `_method`, the key: name and version, such as demo-v1; `_method_name`; `_method_version` counts up when parameters change; `_params` json;
  `_method_sha`, hash of all these. Lookup tables of frozen parameters have these columns only (in brackets: their prefix): @METHOD@
- *check*: `_check`, the key: name, with its unit; `_check_outcome` enum('PASS','WARN','EMPTY','NEEDS_CHOICE','FAIL'); `_check_value`,
  `_check_threshold` (unit); `_check_advice`: what to do about it. Parts with these columns only: @CHECK@

Made by `python -m docs_site.table_map`; do not edit.
"""  # noqa: E501
#: A natural join pairs every row with every row where two tables have no column in common that tells visits apart.
_JOINS = """\
## Joins

A natural join (`A * B`) pairs rows by their common columns. If these do not tell one visit from another, it pairs **every visit with every other**
and raises nothing: `lab.Subject * gdi.SessionGdi` has each person with the visits of all people. Count the rows (`len(A * B)`).

| rows | tables | safe chain |
|---|---|---|
| know their visit (`session_id`) | @VISIT@ | `T * session.Session * lab.Subject` |
| know their video only | @VIDEO@ | `T * video.Video * session.Session * lab.Subject` |
| two of these | any `A` and `B` | `A * video.Video * B`; two that know their visit: `A * B` |
| of a part | `SessionGdi.Measure`, ... | `gdi.SessionGdi.Measure * gdi.SessionGdi.proj('session_id')` |

**Deleting results of chosen visits.** DataJoint 2.3.5 cannot delete where a restriction is itself restricted: "Attribute `pbl_session` is not found in
query" ([cause](../research/reports/2026-11-29_datajoint_delete.md)). Restrict by the keys, and let results of the whole visit go along:

```python
from pbl_schemas import gdi, session

chosen = gdi.GDI & (session.Session & {"subject": "P001"})
(gdi.GDI & chosen.keys()).delete(part_integrity="cascade", prompt=False)  # without prompt=False it asks first
```

`dj.Diagram(gdi.SessionGdi) - 2` in a notebook draws the tables.
"""  # noqa: E501


def kind(cls: Any) -> str:
    """Return the word behind the name of a table: its tier, "" for a manual one."""
    return next(word for base, word in _KINDS.items() if issubclass(cls, base))


def columns(cls: Any) -> list[_Column]:
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
    alone = {name: word for name, cls in tables().items() if (word := _alone(cls))}
    start = _START
    for word in _GROUPS:
        named = (f"`{name}` ({_prefix(tables()[name], word)})" for name in alone if alone[name] == word)
        start = _filled(start, f"@{word.upper()}@", ", ".join(named))
    lines = [*start.splitlines(), "", *joins()]
    stage, written = "", {}
    for name, cls in tables().items():
        if name.split(".")[0] != stage:
            stage = name.split(".")[0]
            lines += ["", f"## {stage}", "", modules()[STAGES.index(stage)].__doc__ or ""]
        if name in alone:
            continue
        lines += ["", f"### {name}{kind(cls)}", *(["", comment(cls)] if comment(cls) else [])]
        lines += ["", *(f"    {line}" for line in _listed(name, cls, written))]
    return "\n".join(lines) + "\n"


def _alone(cls: Any) -> str:
    """Word of the group that is the only one of a table, "" where it has more columns."""
    own = [c[0] for c in columns(cls)]
    word = _group(own, 0) if own else ""
    return word if word and len(own) == len(_GROUPS[word]) else ""


def _prefix(cls: Any, word: str) -> str:
    """Prefix of the columns of a table that has only those of a group."""
    return columns(cls)[0][0].removesuffix(_GROUPS[word][0])


def _filled(text: str, place: str, words: str) -> str:
    """The text with words for a place, its line broken anew."""
    lines = (line.replace(place, words) for line in text.splitlines())
    return "\n".join(
        "\n".join(_wrapped(line, 150, "  " if line[0] in "- " else "")) if words in line else line for line in lines
    )


def _wrapped(text: str, width: int, below: str) -> list[str]:
    return textwrap.wrap(text, width, subsequent_indent=below, break_long_words=False, break_on_hyphens=False)


def _listed(name: str, cls: Any, written: dict[str, list[_Column]]) -> list[str]:
    """The lines of a definition: groups by their word, those that a table before has as well by their names only."""
    own = [c for c in columns(cls) if not _is_origin(c[0], cls)]
    rows: list[_Column] = []
    bare, i = _bare(own), 0
    while i < len(own):
        column, type_, text, in_key = own[i]
        group = _group([c[0] for c in own], i)
        alike, n = _alike(bare[i:], written)
        if group:
            rows.append((f"{column.removesuffix(_GROUPS[group][0])}_*", group, "", in_key))
        elif n:
            rows.append((f"{column}, ..., {own[i + n - 1][0]}", f"as in {alike}", "", in_key))
        else:
            said = (_type(type_), _meaning(column, type_, text), in_key)
            if rows and rows[-1][1:] == said:
                rows[-1] = (f"{rows[-1][0]}, {column}", *said)
            else:
                rows.append((column, *said))
        i += len(_GROUPS[group]) if group else max(n, 1)
    written[name] = bare
    prefix = origin_prefix(cls)
    if prefix is not None:
        rows.append((f"{prefix}*", "origin", "", False))
    keys, others = ([row[:3] for row in rows if row[3] is key] for key in (True, False))
    of_key, of_row = _refers_to(name, cls)
    wide = max([len(row[0]) for row in rows if len(row[0]) <= _WIDEST] or [0])
    lines = [*of_key, *(line for row in keys for line in _line(row, wide))]
    below = [*of_row, *(line for row in others for line in _line(row, wide))]
    return [*lines, "---", *below] if lines and below else lines + below


def _type(text: str) -> str:
    return "" if _PLAIN.fullmatch(text) else text.replace("', '", "','")


def _meaning(column: str, type_: str, text: str) -> str:
    """The comment of a column, less what the top of the page states for all."""
    if type_ == "datetime":
        text = re.sub(r"(^|,? )UTC$", "", text)
    text = re.sub(r"(: [^;]*)?; docs/files\.md$", "", text)
    text = "" if any(column.endswith(end) and text in said for end, said in _SAID.items()) else text
    for long, short in _SHORTER.items():
        text = re.sub(long, short, text)
    return text


def _line(row: tuple[str, str, str], wide: int) -> list[str]:
    """A column with its type and meaning, broken below its name."""
    text = f"{row[0]:<{wide}}  {'  '.join(filter(None, row[1:]))}".rstrip()
    below = " " * (2 + wide * (len(row[0]) <= wide))
    return _wrapped(text, 130, below)


def _group(names: list[str], i: int) -> str:
    """Word for the columns from the i-th on, where they are those of a method or a check."""
    for word, endings in _GROUPS.items():
        if names[i].endswith(endings[0]):
            prefix = names[i].removesuffix(endings[0])
            if tuple(names[i : i + len(endings)]) == tuple(prefix + e for e in endings):
                return word
    return ""


def _alike(own: list[_Column], written: dict[str, list[_Column]]) -> tuple[str, int]:
    """The table that has most of these columns, from the first on, next to each other; and their number."""
    best, most = "", 0
    for name, theirs in written.items():
        for start in range(len(theirs)):
            pairs = zip(own, theirs[start:], strict=False)
            n = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1] and pair[0][3] == own[0][3], pairs))
            if n > most:
                best, most = name, n
    return (best, most) if most >= _LEAST_ALIKE else ("", 0)


def _bare(own: list[_Column]) -> list[_Column]:
    """The columns as those of a trial, which a table of visits repeats after `session_`."""
    return [(name.removeprefix(_VISIT), kind, text.replace(_VISIT, ""), in_key) for name, kind, text, in_key in own]


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
                found[not in_key].append(f"{table} as {new}" if new else table)
    of_key, of_row = ([f"-> {', '.join(tables)}"] if tables else [] for tables in found)
    return of_key, of_row


def _is_origin(column: str, cls: Any) -> bool:
    prefix = origin_prefix(cls)
    return prefix is not None and column in {prefix + c for c in _ORIGIN}


def origin_prefix(cls: Any) -> str | None:
    """Prefix of a table's origin columns, None where it has none."""
    found = [c[0] for c in columns(cls) if c[0].endswith("_code_version")]
    return found[0].removesuffix("code_version") if found else None


if __name__ == "__main__":
    sys.stdout.write(table_map())
