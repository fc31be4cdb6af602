"""Numbered migrations: what brings the tables of an older release to this one.

A migration is a module here whose name begins with its number, `0001_what_it_does.py`, with a docstring and

    def statements(conn) -> list[str]

which reads the server's tables and returns the SQL that is still to be executed: nothing on a database whose tables
are as this version defines them, and what is left after a run that was interrupted. New tables are created by
DataJoint before the migrations run. The table `~migrations` in the schema `lab` records which migrations were
applied, when, by which version, with which statements.
"""

from pbl_schemas.tables_version import Applied, applied

from ._run import Migrated, Migration, available, migrate, workers_of_other_versions
