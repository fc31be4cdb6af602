"""What the server has under the prefix of an installation, and nothing of another one."""

from pathlib import Path

import pytest

import pbl_schemas
from pbl_schemas.operations import catalog
from tests import Environment


def test_tables_and_columns_of_this_installation(declared: None):
    pbl_schemas.activate()
    tables = catalog.tables()
    assert {schema for schema, _ in tables} <= set(catalog.schemas())
    columns = {c.name: c for c in tables["pbl_video", "__video_info"]}
    assert columns["frame_time"].names_files
    assert (columns["fps"].type, columns["fps"].names_files) == ("double", False)
    assert ("pbl_lab", "~lineage") in tables


def test_another_installation_is_not_seen(declared: None, database: Path, environment: Environment):
    """`pb_` as a pattern would match `pbl`: an underscore stands for any character there."""
    environment(PBL_DB_PREFIX="pb")
    assert catalog.pattern() == r"pb\_"
    assert catalog.schemas() == []
    assert catalog.tables() == {}


@pytest.mark.parametrize(
    ("names", "quoted"), [(("a",), "`a`"), (("a", "~~b"), "`a`.`~~b`"), (("x`; --",), "`x``; --`")]
)
def test_names_are_quoted(names: tuple[str, ...], quoted: str):
    assert catalog.quote(*names) == quoted
