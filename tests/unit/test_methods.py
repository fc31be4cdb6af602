"""The registry of methods: from a name, parameters or a stored row to what runs; every stage in the same way."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pbl_pipeline import methods
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, ImplicitAdamParams, unsuited
from pbl_pipeline.gait import GDI_METHODS, GILLETTE_MODEL, GaitParams, score_gdi
from pbl_pipeline.gait.events import METHODS as EVENTS
from pbl_pipeline.keypoints import ModelKeypointParams, ModelParams
from pbl_pipeline.method_file import named_or_file, read_method
from pbl_pipeline.methods import Stage, of_stage, stored
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.tracking import TrackingParams

#: The hash of every method that ships. Rows of results name them, so none may ever change: other parameters are
#: another version.
SHIPPED = {
    ("tracking", "blazepose-tiles", 5): "de3019dc7978cecf",
    ("subject", "walker", 2): "4a27a14ec961fed1",
    ("keypoints", "blazepose-33", 4): "4f2e29a511b43439",
    ("keypoints", "blazepose-heavy", 5): "d27f08d9dd31a380",
    ("keypoints", "blazepose-heavy-30hz", 1): "fb5da96936eacce9",
    ("fit", "paper-2025", 2): "177d1e2810a04248",
    ("fit", "paper-gauss-newton", 3): "bcd62f28a515f283",
    ("fit", "gauss-newton", 5): "45eee8dd5c125990",
    ("fit", "blazepose", 9): "ee5625ffc43bd1be",
    ("fit", "blazepose-measured", 2): "86d0dd61e5426b94",
    ("fit", "markers", 3): "82ac3d5aa4c22e5c",
    ("gait", "phase-transformer", 3): "74a0da658354ff09",
    ("gait", "zeni-2008", 1): "b29b1d5b52f512f4",
    ("gait", "oconnor-2007", 2): "818ff933a9a6365a",
    ("gdi", "pbl-2025-three-angles", 8): "50a2abbdda89c85d",
    ("gdi", "gillette-2008", 1): "a68829dd8731dde1",
    ("gdi", "paper-2025", 1): "a51bf145c1179652",
    ("kinetics", "newton-euler", 5): "d299a6ce470641b0",
}
EVERY = [m for name in methods.STAGES for m in of_stage(name).values()]


def ids(method: methods.Method[Any]) -> str:
    return f"{method.stage} {method.name}"


def row_of(method: methods.Method[Any], **changes: Any) -> dict[str, Any]:
    """As a method table keeps it: parameters are JSON."""
    params = json.loads(method.paramset.canonical_json)
    row = {"stage": method.stage, "name": method.name, "version": method.version, "params": params, "sha": method.hash}
    return row | changes


def refused(row: dict[str, Any]) -> PblError:
    with pytest.raises(PblError) as error:
        stored(**row)
    assert error.value.code == "SOLVER_UNKNOWN"
    return error.value


def test_hashes_of_shipped_methods_never_change():
    found = {(m.stage, m.name, m.version): m.hash for m in EVERY}
    assert found == SHIPPED
    assert Paramset.of("gait", "gait-metrics", 1, GaitParams()).hash == "b3dd91134669ffdd"


@pytest.mark.parametrize("method", EVERY, ids=ids)
def test_a_stored_row_is_the_method_again(method: methods.Method[Any]):
    again = stored(**row_of(method))
    assert again == method
    assert callable(again.function)


@pytest.mark.parametrize("method", EVERY, ids=ids)
def test_whole_numbers_that_lost_their_point_are_the_same_method(method: methods.Method[Any]):
    text = method.paramset.canonical_json
    params = json.loads(text, parse_float=lambda t: int(float(t)) if float(t).is_integer() else float(t))
    assert stored(**row_of(method, params=params)) == method


@pytest.mark.parametrize("method", EVERY, ids=ids)
def test_a_row_of_another_name_keeps_its_function(method: methods.Method[Any]):
    """A user's own parameters under a name of their own: the row itself says of which family it is."""
    stage = of_stage(method.stage)
    own = stage.make("mine", 3, method.params)
    row = row_of(own)
    assert row["params"][stage.kind] == own.family.name
    assert stored(**row) == own
    assert own.function is method.function


@pytest.mark.parametrize("method", EVERY, ids=ids)
def test_what_this_version_does_not_know_is_refused_by_name(method: methods.Method[Any]):
    kind, params = of_stage(method.stage).kind, row_of(method)["params"]
    assert "no-such" in refused(row_of(method, params=params | {kind: "no-such"})).found
    assert "new_weight" in refused(row_of(method, params=params | {"new_weight": 1.0})).found
    assert refused(row_of(method, params=[]))
    assert refused(row_of(method, params=None))
    assert refused(row_of(method, params=params | {kind: ["gauss-newton"]}))


@pytest.mark.parametrize("method", EVERY, ids=ids)
def test_an_edited_row_is_refused(method: methods.Method[Any]):
    params = row_of(method)["params"]
    number = next(k for k, v in params.items() if isinstance(v, (int, float)) and not isinstance(v, bool))
    assert "hash" in refused(row_of(method, params=params | {number: params[number] + 1})).found
    assert "is no" in refused(row_of(method, params=params | {number: str(params[number])})).found
    assert refused(row_of(method, sha="0" * 16))


@pytest.mark.parametrize("name", methods.STAGES)
def test_a_method_is_found_by_whatever_one_has(name: str):
    stage = of_stage(name)
    default = stage.find()
    assert default.name == stage.default
    for given in (default, default.name, default.key, default.params, default.paramset):
        assert stage.find(given) == default
    with pytest.raises(PblError) as error:
        stage.find("psychic")
    assert error.value.code == "SOLVER_UNKNOWN"
    assert default.name in error.value.expected


def test_changed_parameters_have_another_name_and_hash_and_the_same_function():
    stage = of_stage("gait")
    zeni = stage["zeni-2008"]
    moved = stage.find(dataclasses.replace(zeni.params, foot_down_offset_s=0.03))
    assert moved.name == "zeni-2008-custom"
    assert moved.hash != zeni.hash
    assert moved.function is zeni.function
    assert stored(**row_of(moved)) == moved


def test_a_whole_number_for_a_float_is_that_float():
    stage = of_stage("gait")
    params = stage["zeni-2008"].params
    written, meant = (stage.make("mine", 1, dataclasses.replace(params, cutoff_hz=hz)) for hz in (4, 4.0))
    assert written.hash == meant.hash
    assert stored(**row_of(written)) == written == meant


def test_methods_of_registered_models_keep_their_hash():
    model = ModelParams("m", "1" * 64, "2" * 64, "MIT", 10)
    points = of_stage("keypoints").make("m", 1, ModelKeypointParams(model_sha256=model.sha256, model=model))
    assert points.hash == "a6a4513ebb6ec903"
    people = TrackingParams(detector="yolox", model="m", model_sha256="1" * 64, spec_sha256="2" * 64, min_score=0.3)
    assert of_stage("tracking").make("m", 1, people).hash == "30c82bcfebb2a88f"
    assert stored(**row_of(points)) == points


@dataclasses.dataclass(frozen=True)
class Inner:
    share: float = 0.5


@dataclasses.dataclass(frozen=True)
class Params:
    gain: float = 1.0
    places: tuple[tuple[str, float], ...] = (("knee", 2.0),)
    inner: Inner = Inner()
    other: Inner | None = None


class Offers:
    def names(self) -> list[str]:
        return ["guest"]

    def params(self, name: str) -> Params | None:
        return Params(gain=9.0) if name == "guest" else None


def test_a_stage_of_ones_own():
    stage: Stage[Params] = Stage("toy", "family", "first", Offers())
    first = stage.register("first", 1, Params(), max)
    with pytest.raises(ValueError, match="first"):
        stage.register("first", 2, Params(), max)
    second = stage.register("second", 1, Params(gain=2.0))
    assert (first.paramset.params.get("family"), second.paramset.params["family"]) == (None, "first")
    assert list(stage) == ["first", "second"]
    assert stage.names() == ["first", "second", "guest"]
    assert stage.find("guest").params == Params(gain=9.0)
    assert stage.offered("first") is None
    plain = json.loads(second.paramset.canonical_json)
    assert stage.find(Paramset("toy", "second", 1, plain)) == second
    wrong = {
        "'x' is not of type float @ $.inner.share": {"inner": {"share": "x"}},
        "True is not of type float @ $.gain": {"gain": True},
        "extra fields found (z) @ $.inner": {"inner": {"z": 1}},
        "$.places[0]": {"places": [["knee"]]},
    }
    for words, change in wrong.items():
        with pytest.raises(PblError) as error:
            stage.find(Paramset("toy", "second", 1, plain | change))
        assert words in error.value.found
    nested = stage.find(Paramset("toy", "second", 1, plain | {"other": {"share": 1}}))
    assert nested.params.other == Inner(1.0)


def test_asking_for_no_method_loads_no_detector_and_no_jax():
    code = (
        "import sys, pbl_pipeline.methods\n"
        "heavy = {'jax', 'cv2', 'mujoco', 'onnxruntime', 'scipy', 'pbl_pipeline.tracking', 'pbl_pipeline.fit'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("method", "points", "suits"),
    [
        ("gauss-newton", ("blazepose_33", False), "blazepose"),
        ("blazepose", ("bml_movi_87", False), "gauss-newton"),
        ("blazepose", None, "markers"),
        ("markers", ("blazepose_33", False), "blazepose"),
        ("blazepose", ("blazepose_33", False), None),
        ("blazepose-measured", ("blazepose_33", False), None),
        ("blazepose-measured", None, "markers"),
        ("gauss-newton", ("bml_movi_87", False), None),
        ("markers", None, None),
        ("paper-2025", ("blazepose_33", False), None),
        ("one-of-my-own", ("blazepose_33", False), None),
    ],
)
def test_a_fit_method_made_for_other_points_is_named_with_the_one_that_suits(method, points, suits):
    said = unsuited(method, points)
    if suits is None:
        assert said == ""
    else:
        assert said.startswith(f"{method} was made for")
        assert f": {suits} suits" in said


# --- Methods from files: what a file states, and what is refused.


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
