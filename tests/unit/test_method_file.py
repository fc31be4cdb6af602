"""Methods from files: what a file states, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, ImplicitAdamParams
from pbl_pipeline.gait import GDI_METHODS, GILLETTE_MODEL, score_gdi
from pbl_pipeline.gait.events import METHODS as EVENTS
from pbl_pipeline.method_file import named_or_file, read_method
from pbl_pipeline.methods import stored


def write(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_only_what_the_file_states_is_changed(tmp_path):
    found = read_method(write(tmp_path / "slow.json", {"base": "paper-2025", "steps": 9, "cost": {"weight_2d": 0.5}}))
    base = METHODS["paper-2025"]
    assert (found.key, found.stage, found.family) == ("slow-v1", "fit", base.family)
    assert isinstance(found.params, ImplicitAdamParams)
    assert isinstance(base.params, ImplicitAdamParams)
    assert found.params.steps == 9
    assert found.params.cost.weight_2d == 0.5
    back = {**found.paramset.params, "steps": base.params.steps}
    back["cost"] = {**back["cost"], "weight_2d": base.params.cost.weight_2d}
    assert back == {**base.paramset.params, "solver": base.family.name}
    row = found.paramset
    again = stored(stage="fit", name="slow", version=1, params=json.loads(row.canonical_json), sha=found.hash)
    assert again.params == found.params


def test_a_name_or_a_file_says_which_method(tmp_path):
    plain = write(tmp_path / "plain.json", {"stage": "gdi", "lengthening": 0})
    assert named_or_file(GDI_METHODS, str(plain)).params.lengthening == 0
    assert named_or_file(GDI_METHODS, GILLETTE_MODEL) is GDI_METHODS[GILLETTE_MODEL]
    assert named_or_file(GDI_METHODS, None) is GDI_METHODS[GDI_METHODS.default]
    for given, code in ((str(plain), "FILE_FORMAT"), (f"{tmp_path}/no.json", "FILE_MISSING"), ("no", "SOLVER_UNKNOWN")):
        with pytest.raises(PblError, match=rf"^{code}: "):
            named_or_file(METHODS, given)


def test_a_change_of_the_original_index_is_of_nine_angles(tmp_path):
    """Both indices have parameters of one class: the base decides."""
    content = {"stage": "gdi", "base": GILLETTE_MODEL, "min_cycles_per_side": 2}
    found = read_method(write(tmp_path / "strict.json", content))
    assert found.family is GDI_METHODS[GILLETTE_MODEL].family
    row = found.paramset
    again = stored(stage="gdi", name="strict", version=1, params=json.loads(row.canonical_json), sha=found.hash)
    assert again.family is found.family
    assert score_gdi([], model=again).model == "strict"


def test_another_stage_a_name_and_a_base_by_its_key(tmp_path):
    content = {"stage": "gait", "name": "zeni-slow", "base": EVENTS["zeni-2008"].key, "cutoff_hz": 4}
    found = read_method(write(tmp_path / "x.json", content))
    assert (found.key, found.params.cutoff_hz, found.family.name) == ("zeni-slow-v1", 4.0, "zeni-2008")
    assert found.hash == EVENTS.make("zeni-slow", 1, type(found.params)(cutoff_hz=4.0)).hash


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "{",
        {"stage": "feet"},
        {"stage": 3},
        {"base": "nobody"},
        {"name": "blazepose"},  # ships
        {"name": "A B"},
        {"speed": 3},
        {"max_iterations": "many"},
        {"max_iterations": 0},
        {"cost": {"weight_2d": -1}},
        {"cost": {"weight_2d": 1e999}},
        {"stage": "gait", "base": "zeni-2008", "cutoff_hz": 1e999},
    ],
)
def test_files_that_describe_no_method_are_refused(tmp_path, content):
    with pytest.raises(PblError, match="FILE_FORMAT") as caught:
        read_method(write(tmp_path / "mine.json", content))
    assert str(tmp_path / "mine.json") in caught.value.text()


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(PblError, match="FILE_MISSING"):
        read_method(tmp_path / "mine.json")
