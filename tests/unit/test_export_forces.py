"""Forces for OpenSim: the file by hand, and OpenSim's own inverse dynamics on what is exported."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.body import MarkerSet, angle_of, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.export import ExportOptions, write_export
from pbl_pipeline.gait import gait_metrics
from pbl_pipeline.kinetics import (
    CURVES,
    GRAVITY,
    JOINTS,
    MEASURES,
    METHODS,
    Kinetics,
    smooth_motion,
    visit_kinetics,
)
from pbl_pipeline.visit import Recording, Visit
from tests import not_none
from tests.walking_fit import walking_fit

BODY = load_body()
MASS_KG = 70.0
_LOAD = """<ExternalForce name="{0}"><applied_to_body>calcn_{0}</applied_to_body>
<force_expressed_in_body>ground</force_expressed_in_body><point_expressed_in_body>ground</point_expressed_in_body>
<force_identifier>ground_force_{0}_v</force_identifier><point_identifier>ground_force_{0}_p</point_identifier>
<torque_identifier>ground_torque_{0}_</torque_identifier></ExternalForce>"""
_LOADS = """<?xml version="1.0" encoding="UTF-8" ?><OpenSimDocument Version="40000"><ExternalLoads name="loads">
<objects>{0}</objects><groups/><datafile>{1}</datafile></ExternalLoads></OpenSimDocument>"""


def read_sto(path: Path) -> dict[str, np.ndarray]:
    lines = path.read_text().splitlines()
    end = lines.index("endheader")
    values = np.array([[float(v) for v in line.split()] for line in lines[end + 2 :]])
    return dict(zip(lines[end + 1].split(), values.T, strict=True))


@pytest.fixture(scope="module")
def visit() -> Visit:
    """A walk at 100 Hz whose motion is low-passed as the stage does it, and its forces."""
    fit = walking_fit(BODY.joint_names, BODY.sha256, n_frames=240, start_m=(6.0, -4.5, -0.2), marker_names=("nose",))
    fit = dataclasses.replace(fit, orientation_source="measured: calibration")
    motion = smooth_motion(fit.time_s, fit.qpos, METHODS.find().params.cutoff_hz)[0]
    n = len(motion.time_s)
    even = dataclasses.replace(
        fit,
        time_s=motion.time_s,
        qpos=motion.qpos,
        qpos_sd=np.full_like(motion.qpos, np.nan),
        markers_world_m=np.full((n, 1, 3), np.nan),
        phone_quat_wxyz=np.full((n, 4), np.nan),
        residual_2d_px=np.full((n, 1), np.nan),
        residual_3d_m=np.full((n, 1), np.nan),
    )
    gait = gait_metrics([fit])
    found = visit_kinetics([fit], gait.trials, METHODS.find(), mass_kg=MASS_KG)
    return dataclasses.replace(Visit((Recording.of("walk", even),)).with_measures(gait), kinetics=found)


def of(visit: Visit) -> Kinetics:
    return not_none(visit.kinetics)


def test_forces_are_in_newtons_in_opensims_ground(visit: Visit, tmp_path: Path) -> None:
    write_export(visit, ["forces"], tmp_path / "out")
    table = read_sto(tmp_path / "out" / "walk" / "walk.forces.mot")
    series = not_none(of(visit).trials[0].series)
    known = np.isfinite(series.force_bw).all(axis=(1, 2))
    assert table["time"] == pytest.approx(series.time_s[known], abs=1e-6)
    up = MASS_KG * GRAVITY * series.force_bw[known]
    assert table["ground_force_r_vy"] == pytest.approx(up[:, 1, 2], abs=1e-3)
    assert table["ground_force_l_vx"] == pytest.approx(up[:, 0, 0], abs=1e-3)
    assert table["ground_force_l_vz"] == pytest.approx(-up[:, 0, 1], abs=1e-3)
    stands = series.force_bw[known, 1, 2] > 0
    assert table["ground_force_r_pz"][stands] == pytest.approx(-series.centre_m[known][stands, 1, 1], abs=1e-5)
    assert not table["ground_force_r_py"][~stands].any()


def test_without_mass_or_forces_nothing_is_written(visit: Visit, tmp_path: Path) -> None:
    for kinetics in (None, dataclasses.replace(of(visit), mass_kg=None)):
        with pytest.raises(PblError, match=r"^EXPORT_INPUT: "):
            write_export(dataclasses.replace(visit, kinetics=kinetics), ["forces"], tmp_path / "out")
        assert not (tmp_path / "out").exists()


@pytest.mark.needs_extra
@pytest.mark.usefixtures("in_empty_folder")  # OpenSim writes a log where it starts
def test_opensim_finds_the_same_moments(visit: Visit, tmp_path: Path) -> None:
    opensim: Any = pytest.importorskip("opensim")
    walk = dataclasses.replace(visit.recordings[0], markers=_one_marker())
    write_export(dataclasses.replace(visit, recordings=(walk,)), ["osim", "mot", "forces"], tmp_path, _BARE)
    folder, series = tmp_path / "walk", not_none(of(visit).trials[0].series)
    loads = tmp_path / "loads.xml"
    loads.write_text(_LOADS.format("".join(_LOAD.format(s) for s in "rl"), folder / "walk.forces.mot"))
    known = np.isfinite(series.force_bw).all(axis=(1, 2))
    times = series.time_s[known]
    tool, model = opensim.InverseDynamicsTool(), opensim.Model(str(folder / "walk.osim"))
    tool.setModel(model)
    tool.setCoordinatesFileName(str(folder / "walk.mot"))
    tool.setLowpassCutoffFrequency(-1)
    tool.setStartTime(float(times[0]))
    tool.setEndTime(float(times[-1]))
    tool.setExternalLoadsFileName(str(loads))
    tool.setResultsDir(str(tmp_path))
    tool.setOutputGenForceFileName("moments.sto")
    assert tool.run()
    theirs = read_sto(tmp_path / "moments.sto")
    for k, side in enumerate("lr"):
        for j, joint in enumerate(JOINTS):
            ours = np.interp(theirs["time"], times, series.moment_nm_per_kg[known][:, k, j]) * angle_of(joint)[1]
            off = (theirs[f"{joint}_{side}_moment"] / MASS_KG - ours)[10:-10]
            assert np.sqrt(np.mean(off**2)) < 0.01, joint


_BARE = ExportOptions(body_points=False, overwrite=True)


def _one_marker() -> MarkerSet:
    head = BODY.body_names.index("head")
    return MarkerSet("blazepose_33", ("nose",), ("head",), np.array([head]), np.zeros((1, 3)), np.ones(1))


def test_tables_hold_the_measures_and_curves_of_the_forces(visit: Visit, tmp_path: Path) -> None:
    write_export(visit, ["csv"], tmp_path / "out")
    found, tables = of(visit), {p.stem: pd.read_csv(p) for p in (tmp_path / "out").glob("*.csv")}
    wide, long = tables["measures_wide"].set_index("scope").loc["session"], tables["measures_long"]
    reasons = long[long.scope == "session"].set_index("measure").reason
    for name in MEASURES:
        if (measure := found.measures.get(name)) is None:
            assert np.isnan(wide[f"{name}_mean"])
            assert reasons[name] == found.reasons[name]
            continue
        assert wide[f"{name}_left"] == pytest.approx(measure.left, abs=1e-4)
        assert wide[f"{name}_n"] == measure.n
    cycles = {c.number: c for c in found.trials[0].cycles}
    peaks = tables["cycles_wide"].set_index("cycle")["vertical_peak_loading_bw"].dropna()
    assert len(peaks) > 2
    assert peaks.to_dict() == pytest.approx(
        {n: c.measures["vertical_peak_loading_bw"] for n, c in cycles.items() if c.measures}, abs=1e-4
    )
    curves = tables["curves_wide"]
    assert set(CURVES) <= set(curves)
    known = {n: c.curves["force_vertical_bw"] for n, c in cycles.items() if "force_vertical_bw" in c.curves}
    assert known
    for number, curve in known.items():
        assert np.asarray(curves["force_vertical_bw"][curves.cycle == number]) == pytest.approx(curve, abs=1e-4)
    units = tables["data_dictionary"].drop_duplicates("column").set_index("column").unit
    assert units[["vertical_impulse_bw_s", "force_vertical_bw", "hip_work_j_per_kg"]].tolist() == ["BW s", "BW", "J/kg"]
    none = dataclasses.replace(visit, kinetics=None)
    write_export(none, ["csv"], tmp_path / "none")
    assert list(pd.read_csv(tmp_path / "none" / "cycles_wide.csv")) == list(tables["cycles_wide"])
