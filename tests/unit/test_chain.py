"""The order of the tables, read from their definitions."""

from pbl_schemas import chain
from pbl_workers.registry import STAGES

#: Computed table -> those that it needs. Written out here once, so that a change of a foreign key is seen.
NEEDS = {
    "VideoInfo": [],
    "Tracking": ["VideoInfo"],
    "SubjectChoice": ["Tracking"],
    "Keypoints": ["SubjectChoice"],
    "TrialInput": ["Keypoints"],
    "SessionFit": [],  # planned when all trials of a session are decided (pbl_schemas.plan)
    "GaitEvents": ["SessionFit"],
    "GaitCycle": ["GaitEvents"],
    "Spatiotemporal": ["GaitCycle"],
    "GDI": ["GaitCycle"],
    "SessionGdi": ["SessionFit", "Spatiotemporal", "GDI"],
    "SessionQc": ["SessionGdi"],
    "Kinetics": ["GaitCycle", "SessionGdi"],
    "KinematicError": ["SessionFit"],
    "Deidentified": ["VideoInfo"],
}


def test_the_chain_and_what_each_table_needs():
    found = {t.__name__: [n.__name__ for n in chain.needs(t)] for t in chain.computed_tables()}
    assert found == NEEDS
    assert list(found) == list(NEEDS)


def test_every_table_comes_after_those_it_refers_to():
    names = list(chain.tables())
    for name, cls in chain.tables().items():
        for target in chain.references(name, cls):
            assert names.index(target) < names.index(name), (name, target)


def test_followers_are_needs_turned_around():
    by_name = {t.__name__: t for t in chain.computed_tables()}
    for name, table in by_name.items():
        expected = [other for other, needed in NEEDS.items() if name in needed]
        assert [t.__name__ for t in chain.followers(table)] == expected
    assert [t.__name__ for t in chain.before(by_name["SessionFit"])] == list(NEEDS)[:5]


def test_workers_know_what_each_computed_table_costs():
    assert set(STAGES) == set(NEEDS)
