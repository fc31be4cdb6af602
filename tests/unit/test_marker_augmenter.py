"""OpenCap's marker augmenter: against OpenCap's own output, against a laboratory's markers, and bad input.

The network comes from a package index; these tests skip where it is absent and cannot be fetched.
"""

import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.keypoints import AugmenterParams, MarkerAugmenter, read_trc
from pbl_pipeline.keypoints.marker_augmenter import MARKERS, POINTS
from tests import refused
from tests.unit.test_blazepose import asset

#: From y up to z up.
Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
PELVIS = ["r_ASIS", "l_ASIS", "r_PSIS", "l_PSIS"]
RATE_HZ = 60.0


@pytest.fixture(scope="module")
def augmenter() -> MarkerAugmenter:
    for name in ("augmenter_network", "augmenter_mean", "augmenter_std"):
        asset(name)
    return MarkerAugmenter()


def opencap_marker(name: str) -> str:
    """ "l_ASIS" -> "L.ASIS_study", "r_HJC" -> "RHJC_study"."""
    side = {"r": "r", "l": "L"}.get(name[0], "C")
    if name.endswith("HJC"):
        return f"{side.upper()}HJC_study"
    return f"{side}{name[1:].replace('_', '.') if name in PELVIS else name[1:]}_study"


def opencap_name(point: str) -> str:
    """ "right_big_toe" -> "RBigToe"."""
    side, _, part = point.partition("_")
    return side[0].upper() + "".join(w.capitalize() for w in part.split("_")) if part else point.capitalize()


@pytest.fixture(scope="module")
def squats(shared_data, tmp_path_factory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two seconds of squats by a man of 1.79 m and 80 kg, two phones: times, points (T, 15, 3) and the markers
    (T, 35, 3) that OpenCap itself made of them, z up."""
    packed = shared_data / "real" / "motions" / "opensim-org_CMBBE2024" / "Squats.trc.gz"
    if not packed.is_file():
        pytest.skip(f"the recording is absent: {packed}")
    path = tmp_path_factory.mktemp("trc") / "squats.trc"
    path.write_bytes(gzip.decompress(packed.read_bytes()))
    trc = read_trc(path)
    x = trc.xyz_m @ Z_UP

    def of(names: list[str]) -> np.ndarray:
        return x[:120, [trc.names.index(n) for n in names]]

    return trc.time_s[:120], of([opencap_name(n) for n in POINTS]), of([opencap_marker(n) for n in MARKERS])


def standing(n: int = 60) -> np.ndarray:
    """(n, 15, 3) a person of 1.75 m who stands and looks along +x."""
    half = {"shoulder": (0, 0.19, 1.43), "hip": (0, 0.09, 0.91), "knee": (0.01, 0.09, 0.49), "ankle": (0, 0.09, 0.1)}
    half |= {"heel": (-0.05, 0.09, 0.03), "small_toe": (0.16, 0.14, 0.02), "big_toe": (0.2, 0.08, 0.02)}
    rows = [(0, 0, 1.45)]
    for point in POINTS[1:]:
        side, _, part = point.partition("_")
        x, y, z = half[part]
        rows.append((x, y if side == "left" else -y, z))
    return np.repeat(np.array(rows, float)[None], n, axis=0)


def times(n: int) -> np.ndarray:
    return np.arange(n) / RATE_HZ


# --- what it predicts -------------------------------------------------------------------------------------------


def test_it_is_what_opencap_computes(augmenter, squats):
    """OpenCap asks for one heading. It takes its own point for the middle of the hips, here 5.5 mm from the mean of the
    two, so its pelvis and thighs lie up to as much beside ours; all other markers agree."""
    time_s, points, theirs = squats
    ours = MarkerAugmenter(AugmenterParams(headings=1))(time_s, points, 1.79, 80.0).xyz_world_m
    apart_mm = 1000 * np.linalg.norm(ours - theirs, axis=2).mean(axis=0)
    near_hips = np.array([n in PELVIS or "HJC" in n or "thigh" in n for n in MARKERS])
    assert apart_mm[~near_hips].max() < 2.5
    assert np.median(apart_mm[~near_hips]) < 0.6
    assert apart_mm[near_hips].max() < 7


def test_a_laboratorys_markers(augmenter, shared_data):
    """A walk with skin markers; the joints that the network wants are made of them (hips by others' regression, knees
    and ankles 5 cm inside the lateral markers), so a part of the error is theirs."""
    trc = read_trc(shared_data / "real" / "marker_ik" / "walking1.trc")
    marker = dict(zip(trc.names, np.moveaxis(trc.xyz_m, 1, 0), strict=True))
    if abs(np.nanmedian(marker["C7"][:, 2] - marker["L_toe"][:, 2])) < 1.0:
        marker = {n: x @ Z_UP for n, x in marker.items()}
    inwards = marker["L.ASIS"] - marker["r.ASIS"]
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    points = {"neck": (marker["C7"] + marker["R_Sternum"] / 2 + marker["L_Sternum"] / 2) / 2}
    for side, s, sign in (("right", "r", 1), ("left", "L", -1)):
        points |= {
            f"{side}_shoulder": marker[f"{s.upper()}_Shoulder"] - [0, 0, 0.045],
            f"{side}_hip": marker[f"{s.upper()}_HJC_reg"],
            f"{side}_knee": marker[f"{s}_knee"] + 0.05 * sign * inwards,
            f"{side}_ankle": marker[f"{s}_ankle"] + 0.045 * sign * inwards,
            f"{side}_heel": marker[f"{s}_calc"],
            f"{side}_small_toe": marker[f"{s}_5meta"],
            f"{side}_big_toe": marker[f"{s}_toe"],
        }
    found = augmenter(trc.time_s, np.stack([points[n] for n in POINTS], axis=1))
    assert len(found.assumed) == 2  # neither height nor mass is known
    for names, most_mm in ((PELVIS, 35), (["r_knee", "l_knee"], 30), (["r_ankle", "l_ankle"], 45), (["C7"], 45)):
        error = [
            found.xyz_world_m[:, MARKERS.index(n)] - marker[opencap_marker(n).removesuffix("_study")] for n in names
        ]
        assert 1000 * np.linalg.norm(error, axis=-1).mean() < most_mm, names


def test_which_way_somebody_faces_does_not_matter(augmenter, squats):
    time_s, points, _ = squats
    reference = augmenter(time_s, points, 1.79, 80.0).xyz_world_m
    apart = {}
    for degrees in (20, 45):
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        turned = augmenter(time_s, points @ turn.T + [3.0, -2.0, 0.5], 1.79, 80.0).xyz_world_m
        apart[degrees] = 1000 * np.abs((turned - [3.0, -2.0, 0.5]) @ turn - reference).max()
    assert apart[45] < 0.1  # the eight headings are the same
    assert apart[20] < 12


def test_the_rate_of_the_video_hardly_matters(augmenter, squats):
    time_s, points, _ = squats
    reference = augmenter(time_s, points, 1.79, 80.0).xyz_world_m
    half = augmenter(time_s[::2], points[::2], 1.79, 80.0).xyz_world_m
    assert 1000 * np.abs(half - reference[::2]).max() < 10


def test_what_is_not_known_is_assumed_and_told(augmenter):
    found = augmenter(times(60), standing())
    assert found.height_m == pytest.approx(1.75, abs=0.05)
    assert found.mass_kg == pytest.approx(70, abs=4)
    assert len(found.assumed) == 2
    assert "height not known" in found.assumed[0]
    assert "mass not known" in found.assumed[1]
    known = augmenter(times(60), standing(), 1.75, 70.0)
    assert known.assumed == ()
    assert "BSD-3-Clause" in known.origin
    assert np.abs(known.xyz_world_m - found.xyz_world_m).max() < 0.01
    small = augmenter(times(60), standing() * 0.85, 1.75, 70.0)
    assert len(small.assumed) == 1
    assert "stated height 1.75 m, but legs of 1.4" in small.assumed[0]
    child = augmenter(times(60), standing() * 0.7)
    assert any("adults only" in a for a in child.assumed)
    asis = known.xyz_world_m[-1, [MARKERS.index(n) for n in PELVIS]]
    assert np.all(np.diff(asis[:, 1].reshape(2, 2), axis=1) > 0.05)  # right, then left
    assert np.all(asis[:2, 0] > asis[2:, 0] + 0.1)  # the anterior ones are in front
    assert np.all((asis[:, 2] > 0.9) & (asis[:, 2] < 1.1))


def test_a_gap_is_left_open(augmenter):
    points = standing(90)
    points[40:45, POINTS.index("left_heel")] = np.nan
    points[:5] = np.nan
    found = augmenter(times(90), points, 1.75, 70.0).xyz_world_m
    unknown = np.isnan(found).all(axis=(1, 2))
    np.testing.assert_array_equal(np.flatnonzero(unknown), [*range(5), *range(40, 45)])
    assert np.isfinite(found[~unknown]).all()


# --- bad input --------------------------------------------------------------------------------------------------


def without(point: str) -> np.ndarray:
    points = standing()
    points[:, POINTS.index(point)] = np.nan
    return points


def gaps() -> np.ndarray:
    points = standing()
    points[::10] = np.nan
    return points


@pytest.mark.parametrize(
    ("points", "size", "found"),
    [
        (without("left_heel"), (None, None), "never known: left_heel"),
        (gaps(), (None, None), "no stretch of 0.25 s"),
        (1000 * standing(), (1.75, 70), "legs imply"),
        (standing(), (175, 70), "stated height"),
        (standing(), (1.75, 70_000), "a mass of 70000 kg"),
        (standing() * [1, 1, -1], (None, None), "neck below the ankles"),
        (standing()[:, :14], (None, None), "shape"),
    ],
)
def test_unsuitable_input_is_refused(augmenter, points, size, found):
    error = refused("AUGMENTER_INPUT", augmenter, times(60), points, *size)
    assert found in error.found
    assert error.next_step


def test_times_that_run_backwards_and_another_network(augmenter):
    assert "increasing" in refused("AUGMENTER_INPUT", augmenter, times(60)[::-1], standing()).expected
    refused("SOLVER_UNKNOWN", MarkerAugmenter, AugmenterParams(model_sha256="0" * 64))
