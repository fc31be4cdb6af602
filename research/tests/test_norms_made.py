"""The normative sets that ship are what the commands of `research.norms` build."""

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import (
    load_norm,
)
from research.norms import BUILDERS, build_gillette, gillette_vectors
from tests.unit.test_gait_gdi import index_another_way


def test_the_set_is_what_the_command_builds(shared_data):
    source = shared_data / "real" / "gdi_gillette" / "GDI_Calc_Fast_Data.mat"
    shipped, built = load_norm("gillette-166-three-angles"), build_gillette(source)
    assert shipped.source_sha256 == built.source_sha256
    np.testing.assert_allclose(shipped.mean_deg, built.mean_deg, rtol=1e-6)
    np.testing.assert_allclose(shipped.components, built.components, atol=1e-6)
    vectors = gillette_vectors(source).reshape(166, 9, 51)[:, [3, 4, 6], :50].reshape(166, 150)
    scores = shipped.index(vectors)
    assert scores.mean() == pytest.approx(100, abs=1e-3)
    assert scores.std(ddof=1) == pytest.approx(10, abs=1e-3)
    np.testing.assert_allclose(scores, index_another_way(vectors, vectors), atol=1e-3)


def test_not_a_gillette_file(tmp_path):
    path = tmp_path / "x.mat"
    path.write_bytes(b"nothing")
    with pytest.raises(PblError, match="NORM_INVALID"):
        build_gillette(path)


@pytest.mark.slow
def test_the_sets_are_what_the_command_builds(shared_data):
    source = shared_data / "real" / "gdi_gillette" / "GDI_Calc_Fast_Data.mat"
    for name, (build, digits) in BUILDERS.items():
        built, shipped = build(source), load_norm(name)
        same = (
            "name",
            "version",
            "n",
            "source",
            "licence",
            "convention",
            "variables",
            "source_sha256",
            "angle_model",
            "mapped_from",
        )
        assert [getattr(built, k) for k in same] == [getattr(shipped, k) for k in same]
        off = 1e-12 if digits is None else 1e-5
        for k in ("mean_deg", "components", "percent", "ln_mean", "ln_sd", "explained_share"):
            np.testing.assert_allclose(getattr(built, k), getattr(shipped, k), atol=off, rtol=0, err_msg=f"{name} {k}")
