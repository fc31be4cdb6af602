"""A process of the upgrade test: `build FOLDER` makes an old database, `migrate [N SECONDS]` upgrades it.

With a statement's number N the process kills itself so many seconds after it has begun that statement, counted over all
migrations: before the server has it, while it works, or when it is done.
"""

import dataclasses
import os
import signal
import sys
import threading
from contextlib import closing
from pathlib import Path

import pytest

import pbl_schemas
from pbl_pipeline.body import load_body
from pbl_pipeline.validation import reference_of_fit
from pbl_schemas import connection, migrations
from pbl_schemas.chain import ON_REQUEST
from pbl_schemas.decisions import event_corrections, review_decisions
from pbl_schemas.intake.references import add_reference
from pbl_workers.populate import populate
from tests.integration import chain, older_tables
from tests.rows import register
from tests.walking_fit import walking_fit


def build(folder: Path) -> None:
    """Three visits through the chain with a correction, decisions and a reference, then all migrations taken back."""
    with pytest.MonkeyPatch.context() as patch:
        chain.install(patch)
        pbl_schemas.activate()
        videos = [chain.small_video(folder, name) for name in "abc"]
        first, _, third = (register(v, session_label=f"2026-0{i}-01")[0] for i, v in enumerate(videos, 1))
        body = load_body()
        truth = reference_of_fit(walking_fit(body.joint_names, body.sha256, n_frames=chain.N_FRAMES), "optical markers")
        bent = {**truth.angles_deg, "knee_flexion_r": truth.angles_deg["knee_flexion_r"] + 4.0}
        dataclasses.replace(truth, angles_deg=bent).save(folder / "truth.npz")
        add_reference(first, folder / "truth.npz", dataset="LAB")
        _populate()
        found = event_corrections.shown_events(first)
        assert found is not None
        (time, side, kind, _), *others = found.events
        event_corrections.save(first, [(time + 0.02, side, kind), *(e[:3] for e in others)], "A. First", found.state)
        _populate()
        review_decisions.mark_not_usable(third, "camera_moved", by="B. Second")
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        older_tables.undo_0017(cursor)
        older_tables.undo_0016(cursor)
        older_tables.undo_0015(cursor)
        older_tables.undo_0014(cursor)
        older_tables.undo_0013(cursor)
        older_tables.undo_0012(cursor)
        older_tables.undo_0010(cursor)
        older_tables.undo_0009(cursor)
        older_tables.undo_0008(cursor)
        older_tables.undo_0007(cursor)
        older_tables.undo_0006(cursor)
        older_tables.undo_0005(cursor, third)
        older_tables.undo_0004(cursor)
        older_tables.undo_0003(cursor)
        older_tables.undo_0002(cursor)
        older_tables.undo_0001(cursor)
        cursor.execute(older_tables.NOT_RECORDED)


def _populate() -> None:
    names = [t.__name__ for t in pbl_schemas.computed_tables() if t.__name__ not in ON_REQUEST]
    run = populate([*names, "KinematicError"])
    assert not {t.table: t.errors for t in run.tables if t.errors}


def migrate(at: int | None = None, after_s: float = 0.0) -> None:
    """Upgrade; print every statement, and in the end what a second run would do."""
    begun = 0

    def say(line: str) -> None:
        nonlocal begun
        begun += 1
        sys.stdout.write(line.strip() + "\n")
        sys.stdout.flush()
        if begun == at:
            threading.Timer(after_s, os.kill, (os.getpid(), signal.SIGKILL)).start()
            if not after_s:
                threading.Event().wait()  # the server is not to have it

    migrations.migrate(say=say)
    again = migrations.migrate(dry_run=True)
    assert again == migrations.Migrated([], [], []), again


if __name__ == "__main__":
    command, *more = sys.argv[1:]
    if command == "build":
        build(Path(more[0]))
    elif more:
        migrate(int(more[0]), float(more[1]))
    else:
        migrate()
