"""`pbl method`: custom methods."""

from __future__ import annotations

from pathlib import Path

import click


@click.group(epilog="Example: pbl method add slow.json")
def method() -> None:
    """Custom methods: a registered one with other parameters, under a new name. `pbl list methods` shows all."""


@method.command(epilog="Example: pbl method add slow.json && pbl reprocess --table SessionFit --new-method slow --yes")
@click.argument("file", type=click.Path(path_type=Path))
def add(file: Path) -> None:
    """Register the method that FILE describes (docs/files.md, section Methods), for every worker of this database.

    Registered methods never change: other parameters under the same name are its next version, the same ones change
    nothing. `pbl ingest` and `pbl reprocess --new-method` then take its name.
    """
    from pbl_pipeline.method_file import read_method

    found = read_method(file)
    import pbl_schemas
    from pbl_schemas.method_rows import register
    from pbl_schemas.methods import METHOD_TABLES

    pbl_schemas.activate()
    table = next(t for t in METHOD_TABLES if t.stage == found.stage)
    key, new = register(table, found)
    click.echo(f"{key}: {'registered' if new else 'known already, nothing was changed'} as a {found.stage} method")
