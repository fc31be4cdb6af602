"""Numbered migrations: what brings the tables of an older version to this one.

A migration is a module here whose name begins with its number, `0002_what_it_does.py`, with a docstring and

    def statements(conn) -> list[str]

which looks at the server and returns what is still to be done, so that it can be repeated: where it was broken off,
it goes on. `REPEATS = True` marks one that is planned at every run and not only once. The table `~migrations` in the
schema `lab` says which were applied, when, by which version, with which statements.
"""

from ._run import Applied, Migration, Outcome, applied, available, migrate

__all__ = ["Applied", "Migration", "Outcome", "applied", "available", "migrate"]
