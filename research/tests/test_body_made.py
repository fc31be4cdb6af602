"""The body and its markers that ship are what `python -m research.body` writes."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from pbl_pipeline.body import SCALE_NAMES, load_body
from research.body import build
from tests.unit.test_body_model import DATA


def test_figures_are_carried_over(shared_data):
    figures = json.loads((shared_data / "body_model_figures.json").read_text())
    body, model = load_body(), load_body().mj_model
    assert list(body.body_names) == [b["name"] for b in figures["bodies"]]
    assert list(figures["scale_groups"]) == list(SCALE_NAMES)
    number = 0
    for i, wanted in enumerate(figures["bodies"], 1):
        assert model.body(int(model.body_parentid[i])).name == wanted["parent"]
        np.testing.assert_allclose(model.body_pos[i], wanted["pos"], atol=1e-12)
        np.testing.assert_allclose(model.body_ipos[i], wanted["com"], atol=1e-12)
        assert model.body_mass[i] == pytest.approx(wanted["mass"])
        for joint in wanted["joints"]:
            assert body.joint_names[number] == joint["name"]
            assert model.jnt_type[number] == {"slide": 2, "hinge": 3}[joint["type"]]
            unit = np.array(joint["axis"]) / np.linalg.norm(joint["axis"])
            np.testing.assert_allclose(model.jnt_axis[number], unit, atol=1e-9)
            if joint["range"] is not None:
                np.testing.assert_allclose(np.rad2deg(body.joint_range_rad[number]), joint["range"], atol=1e-9)
            number += 1
        group = SCALE_NAMES[body.scale_index[i - 1]]
        members = figures["scale_groups"][group]
        assert wanted["name"] in members or (group == "overall" and wanted["name"] in ("torso", "head"))
    assert number == 40


def test_shipped_files_are_what_the_builder_writes(shared_data, tmp_path):
    result = CliRunner().invoke(build, [str(shared_data / "body_model_figures.json"), "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    for name in ("pbl_body_40.xml", "markers_bml_movi_87.csv"):
        assert (tmp_path / name).read_text() == (DATA / name).read_text(), f"run research.body: {name}"
