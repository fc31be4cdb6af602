"""Natural joins with the visit, as an analyst writes them: a row for each that there is, never every pair."""

import itertools
import re
from pathlib import Path
from typing import Any

import pytest
from datajoint import DataJointError

import pbl_schemas
from docs_site import table_map
from pbl_schemas import fit, gdi, lab, session, video
from pbl_schemas.chain import ON_REQUEST, tables
from pbl_schemas.datajoint_setup import dj
from pbl_workers.populate import populate
from tests.rows import register

from . import chain

VISITS, VIDEOS = 4, 8
#: Joins by a method's name or by nothing: every visit with every other.
EVERY_PAIR = ((fit.TrialInput, fit.SessionFit), (video.VideoInfo, fit.SessionFit), (lab.Subject, gdi.SessionGdi))


@pytest.fixture(scope="module")
def visits(module_tables: Path) -> None:
    """Two people with two visits each of two videos each, computed."""
    for person in ("P001", "P002"):
        for label in ("2026-03-01", "2026-06-01"):
            paths = [chain.small_video(module_tables, f"{person}-{label}-{i}") for i in range(2)]
            register(*paths, subject=person, session_label=label)
    populate()


def _computed() -> list[Any]:
    return [t for t in pbl_schemas.computed_tables() if t.__name__ not in ON_REQUEST]


def _of_fit() -> list[Any]:
    """The computed tables below a set: each row is of one visit."""
    return [t for t in _computed() if "fit_set" in t.heading.primary_key]


def test_what_is_computed_from_a_fit_is_joined_with_its_own_visit(visits: None):
    assert len(_of_fit()) == 7
    for table in _of_fit():
        n = VIDEOS if "video_id" in table.heading.primary_key else VISITS
        assert len(table()) == n
        for joined in (
            table * session.Session,
            session.Session * table,
            table * session.Session * lab.Subject,
            table * fit.FitSet * session.Session,
        ):
            assert len(joined) == n, table.__name__
        rows = (table * session.Session * lab.Subject).to_dicts()
        truth = (fit.FitSet.proj("session_id") * session.Session).to_dicts()
        subject = {r["fit_set"]: (r["session_id"], r["subject"]) for r in truth}
        assert all((r["session_id"], r["subject"]) == subject[r["fit_set"]] for r in rows)
    kinematic = next(t for t in pbl_schemas.computed_tables() if t.__name__ == "KinematicError")
    assert "session_id" in kinematic.heading.secondary_attributes


def test_with_the_videos_there_is_a_row_for_each_video(visits: None):
    for table in _computed():
        # One row per visit: with each video of the visit. One per video or trial: with its own.
        for joined in (table * video.Video, table * video.Video * session.Session * lab.Subject):
            assert len(joined) == VIDEOS, table.__name__


def _key(table: Any) -> Any:
    """The columns of a table that a join goes by."""
    return table.proj(*({"session_id"} & set(table.heading.secondary_attributes)))


def test_two_results_with_the_video_between_them_are_of_one_visit(visits: None):
    """The safe chain of docs/tables.md, for every pair of computed tables."""
    for first, second in itertools.combinations(_computed(), 2):
        pair = _key(first) * _key(video.Video) * _key(second)
        assert len(pair) == VIDEOS, (first.__name__, second.__name__)
    assert len(gdi.SessionGdi.Measure.proj() * _key(gdi.SessionGdi)) == len(gdi.SessionGdi.Measure())
    for first, second in EVERY_PAIR:
        assert len(first() * second()) == len(first()) * len(second())


def test_the_section_of_joins_names_every_computed_table(visits: None):
    rows = [row for row in table_map.joins() if row.startswith("| know their")]
    named = {name: "session_id" in row for row in rows for name in re.findall(r"`([a-z]+\.\w+)`", row.split("|")[2])}
    computed = {name: table for name, table in tables().items() if table in pbl_schemas.computed_tables()}
    assert named == {name: "session_id" in table.heading.names for name, table in computed.items()}


def test_a_delete_behind_a_restricted_restriction_is_datajoints_own_error(visits: None):
    """docs/tables.md, Joins. Where this fails DataJoint has mended it: the way around can go."""
    one = session.Session & {"subject": "P001", "session_label": "2026-06-01"}
    for chosen in (gdi.GDI & one, video.VideoInfo & (video.Video & one)):
        with pytest.raises(DataJointError, match=r"Attribute `[a-z_]+` is not found in query"):
            chosen.delete(prompt=False)
        assert len(chosen) == 2


def test_results_of_several_tables_and_a_restriction_to_visits(visits: None):
    results = [t.proj(*t.heading.secondary_attributes) for t in _of_fit() if "video_id" not in t.heading.primary_key]
    joined = results[0]
    for other in results[1:]:
        joined = joined * other
    assert len(joined * session.Session) == VISITS
    one = session.Session & {"subject": "P001", "session_label": "2026-06-01"}
    assert len(gdi.SessionGdi & one) == 1
    by_person = dj.U("subject").aggr(gdi.SessionGdi * session.Session, n="count(*)").to_dicts()
    assert by_person == [{"subject": "P001", "n": 2}, {"subject": "P002", "n": 2}]
