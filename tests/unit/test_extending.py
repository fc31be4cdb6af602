"""docs/extending.md does what it says: its code, in a copy of the package, is one file and one line for each method."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

RUN = """
import json, sys
from pathlib import Path
import numpy as np
from pbl_pipeline.fit import fit_session
from pbl_pipeline.gait import detect_events
from pbl_pipeline.methods import of_stage, stored
from pbl_pipeline.synthetic import SynthSpec, synthesise
from pbl_pipeline.tracking import choose_subject, track_people
from tests.unit.gait_walker import Walker, make_feet
from tests.videos import constant_rate, write_video

def again(method):
    params = json.loads(method.paramset.canonical_json)
    return stored(stage=method.stage, name=method.name, version=method.version, params=params, sha=method.hash)

out, time, walker = {}, np.arange(270) / 30, Walker()
for name in ("step-length", "zeni-slow"):
    method = of_stage("gait")[name]
    found = detect_events(make_feet(time, walker), again(method))
    true = [e for e in walker.events(time[-1]) if e[2] == "foot_down" and 0.5 < e[0] < time[-1] - 0.5]
    off = [min(abs(t - at) for t in found.times(side, "foot_down")) for at, side, _ in true]
    out[name] = {"method": found.method, "hash": found.params_hash == method.hash, "status": found.status,
                 "stored": again(method) == method, "contacts": len(off), "worst_s": max(off)}

def frames():
    for i in range(60):
        image = np.full((360, 640, 3), (60, 160, 40), np.uint8)
        image[80:280, 60 + 7 * i : 120 + 7 * i] = (40, 40, 200)
        yield image

path = write_video(Path(sys.argv[1]) / "walk.mkv", frames(), constant_rate(60), "ffv1", pixel_format="bgr0")
method = of_stage("tracking")["backdrop"]
tracking = track_people(path, again(method))
choice = choose_subject(tracking)
out["backdrop"] = {"people": len(tracking.persons), "detector": tracking.detector, "chosen": choice.person_id,
                   "box": [float(v) for v in tracking.persons[0].box_px[30]], "stored": again(method) == method}
made = synthesise(SynthSpec(seed=1, seconds=2.0, noise="none"))
method = of_stage("fit")["placed"]
fit = fit_session([made.keypoints], ["walk"], again(method))
off = np.linalg.norm(fit.trials[0].qpos[:, :3] - made.truth.qpos[:, :3], axis=1)
out["placed"] = {"solver": fit.solver, "hash": fit.params_hash == method.hash, "pelvis_m": float(np.nanmedian(off)),
                 "stored": again(method) == method, "checks": [c.check for c in fit.qc]}
print(json.dumps(out))
"""


def blocks() -> dict[str, list[str]]:
    """The page's code by the file that its first line names."""
    found: dict[str, list[str]] = {}
    for code in re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "extending.md").read_text(), re.M | re.S):
        path, _, text = code.partition("\n")
        assert path.startswith("# pbl_pipeline/"), path
        found.setdefault(path.removeprefix("# "), []).append(text)
    return found


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """What a process finds with a copy of the package to which the page's files and lines were added."""
    folder = tmp_path_factory.mktemp("copy")
    for name in ("pbl_pipeline", "tests"):
        ignored = shutil.ignore_patterns("__pycache__", "integration", "benchmarks", "end_to_end")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    for path, texts in blocks().items():
        file = folder / path
        assert file.exists() == file.name.endswith("methods.py"), f"{path}: a method is a new file and a line"
        with file.open("a") as f:
            f.writelines(texts)
    command = [sys.executable, "-c", RUN, str(folder)]
    done = subprocess.run(
        command, cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["step-length", "zeni-slow"])
def test_event_methods(results, name):
    found = results[name]
    assert (found["method"], found["status"], found["hash"], found["stored"]) == (name, "PASS", True, True)
    assert found["contacts"] >= 14
    assert found["worst_s"] < 0.1


@pytest.mark.slow
def test_a_person_detector(results):
    found = results["backdrop"]
    assert (found["people"], found["detector"], found["chosen"], found["stored"]) == (1, "backdrop", 1, True)
    assert found["box"] == pytest.approx([270, 80, 330, 280], abs=10)


@pytest.mark.slow
def test_a_solver(results):
    found = results["placed"]
    assert (found["solver"], found["hash"], found["stored"]) == ("placed", True, True)
    assert found["pelvis_m"] < 0.03
    assert "residual_3d_cm" in found["checks"]


def test_a_registration_is_one_line():
    for path, texts in blocks().items():
        if path.endswith("methods.py"):
            for text in texts:
                lines = [line for line in text.splitlines() if line and not line.startswith("from ")]
                assert len(lines) == 1, path
                assert lines[0].startswith("METHODS.register("), path
