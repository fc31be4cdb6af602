"""Whether the tables on the server are those of an older version: asked at every start, before anything reads them."""

from __future__ import annotations

import re

from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError

from . import connection
from .chain import tables
from .operations import catalog

#: A line of a definition that makes a column of the table's own: its name.
_OWN = re.compile(r"^\s*([a-z]\w*)\s*[:=]", re.MULTILINE)


def refuse_older() -> None:
    """Refuse a database of an older version: one of its tables lacks columns of this version's definition.

    Raises
    ------
    PblError
        DB_MIGRATION.
    """
    if missing := missing_columns():
        more = f" and {len(missing) - 4} more" if len(missing) > 4 else ""
        raise PblError(
            "DB_MIGRATION",
            found=f"tables of an older version, without {', '.join(missing[:4])}{more}",
            expected=f"tables as pbl-pipeline {code_version()} defines them",
            next_step="`pbl db migrate --dry-run` says what will be done, `pbl db migrate` does it; of a database of a "
            "development version it says that no migration does: set PBL_HOME to a new folder, ingest the videos again",
        )


def missing_columns() -> list[str]:
    """Columns that tables on the server lack, as `table.column`; tables that are missing do not count.

    One query, for every start: columns that a foreign key brings are left to `migrations.migrate`.
    """
    there = {names: {c.name for c in columns} for names, columns in catalog.tables().items()}
    out = []
    for path, cls in tables().items():
        names = connection.schema_name(path.split(".")[0]), cls.table_name
        out += [f"{names[1]}.{c}" for c in _OWN.findall(cls.definition) if c not in there.get(names, {c})]
    return out
