"""`pbl db config`: the files with which plain `import datajoint` connects."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("."),
    show_default=True,
    help="Folder of the notebooks or programs; programs in folders below find the files as well.",
)
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier call (the port may have changed).")
def config(out: Path, overwrite: bool) -> None:
    """Write datajoint.json and .secrets/ of the database in use, so that plain `import datajoint` connects to it.

    The login is the one of this call: DJ_USER's, or the embedded database's. .secrets/ is readable for you alone and
    keeps itself out of git. DataJoint goes on asking before it deletes (safemode).

    Example: pbl db config --out notebooks
    """
    from schemas.operations.client_config import AGGREGATE, is_mariadb, write_config

    for path in write_config(out, overwrite):
        click.echo(path)
    if is_mariadb():
        click.echo(
            "The server is MariaDB, where A.aggr(B) of plain DataJoint fails (error 1055). After each connect:\n"
            f"{AGGREGATE}"
        )
