"""Marker sets: names, places, mirror symmetry, a lab's own table, and what is refused."""

import json

import numpy as np
import pytest

from pbl_pipeline.body import MARKER_SETS, MarkerSet, load_body, load_marker_set, marker_positions, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import MarkerAugmenter

pytestmark = pytest.mark.usefixtures("little_optimised")

BLAZEPOSE = (
    "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear right_ear "
    "mouth_left mouth_right left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_pinky "
    "right_pinky left_index right_index left_thumb right_thumb left_hip right_hip left_knee right_knee left_ankle "
    "right_ankle left_heel right_heel left_foot_index right_foot_index"
)
MPI_INF_3DHP = (
    "head_top neck right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist right_hip right_knee "
    "right_ankle left_hip left_knee left_ankle pelvis spine head"
)
BODY_25B = (
    "Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist LHip RHip LKnee RKnee LAnkle RAnkle Neck "
    "Head LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel"
)
#: No left or right: on the midline but for the figures' own scatter.
BML_MIDLINE = {"backneck", "upperback", "clavicle", "sternum", "umbilicus", "Head", "mhip", "CHip", "Neck"}


def neutral(markers: MarkerSet) -> dict[str, np.ndarray]:
    """Where the points of a set are on the unscaled body in its neutral pose (m)."""
    x = np.asarray(marker_positions(load_body(), markers, np.zeros(40), np.ones(8), np.zeros((len(markers), 3))))
    return dict(zip(markers.names, x, strict=True))


def other_side(set_name: str, name: str) -> str | None:
    if set_name == "bml_movi_87":
        if name in BML_MIDLINE:
            return None
        return {"l": "r", "r": "l", "L": "R", "R": "L"}[name[0]] + name[1:]
    if set_name == "body25b":
        return {"L": "R", "R": "L"}[name[0]] + name[1:] if name[0] in "LR" else None
    if set_name == "opencap_35":
        return {"l": "r", "r": "l"}[name[0]] + name[1:] if name[1] == "_" else None
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left") if "right" in name else None


def test_names():
    assert set(MARKER_SETS) == {"bml_movi_87", "blazepose_33", "body25b", "halpe_26", "mpi_inf_3dhp_17", "opencap_35"}
    for name, names in (("blazepose_33", BLAZEPOSE), ("mpi_inf_3dhp_17", MPI_INF_3DHP), ("body25b", BODY_25B)):
        assert " ".join(marker_set(name).names) == names
    assert len(marker_set("bml_movi_87")) == 87
    assert marker_set("opencap_35").names == MarkerAugmenter.markers
    assert set(MarkerAugmenter.points) <= set(marker_set("halpe_26").names)


def test_bml_movi_is_the_figures(shared_data):
    figures = json.loads((shared_data / "body_model_figures.json").read_text())
    markers = marker_set("bml_movi_87")
    assert list(markers.names) == figures["bml_movi_87_order"]
    for name, body, position in zip(markers.names, markers.body_names, markers.position_m, strict=True):
        assert body == figures["sites"][name]["body"]
        np.testing.assert_allclose(position, figures["sites"][name]["pos"], atol=1e-12)


@pytest.mark.parametrize("name", MARKER_SETS)
def test_left_and_right_are_mirror_images(name):
    markers = marker_set(name)
    assert tuple(load_body().body_names[i] for i in markers.body_index) == markers.body_names
    pairs = 0
    for i, (marker, body) in enumerate(zip(markers.names, markers.body_names, strict=True)):
        partner = other_side(name, marker)
        if partner is None:
            continue
        j = markers.names.index(partner)
        swapped = body[:-1] + {"r": "l", "l": "r"}[body[-1]] if body[-2:] in ("_r", "_l") else body
        assert markers.body_names[j] == swapped
        np.testing.assert_array_equal(markers.position_m[j], markers.position_m[i] * [1, 1, -1])
        pairs += 1
    assert pairs >= 12
    if name != "bml_movi_87":
        for marker, position in zip(markers.names, markers.position_m, strict=True):
            assert other_side(name, marker) is not None or position[2] == 0


@pytest.mark.parametrize("name", MARKER_SETS)
def test_symmetric_pose_gives_mirrored_markers(name):
    body, markers = load_body(), marker_set(name)
    rng = np.random.default_rng(4)
    qpos = np.zeros(40)
    for i, joint in enumerate(body.joint_names):
        if joint.endswith("_r"):
            low, high = np.clip(body.joint_range_rad[i], -0.7, 0.7)
            qpos[i] = qpos[body.joint_names.index(joint[:-1] + "l")] = rng.uniform(low, high)
    qpos[body.joint_names.index("lumbar_extension")] = -0.3
    scale = np.array([1.05, 0.95, 1.1, 0.9, 1.1, 0.9, 1.02, 1.02])
    x = np.asarray(marker_positions(body, markers, qpos, scale, np.zeros((len(markers), 3))))
    for i, marker in enumerate(markers.names):
        partner = other_side(name, marker)
        if partner is not None:
            np.testing.assert_allclose(x[markers.names.index(partner)], x[i] * [1, -1, 1], atol=2e-6)


@pytest.mark.parametrize("name", ["blazepose_33", "mpi_inf_3dhp_17"])
def test_markers_by_anatomy_agree_with_the_published_sites(name):
    """Joint centres lie near the published sites that name the same joint, on the inside of the skin markers."""
    ours, published = (neutral(marker_set(n)) for n in (name, "bml_movi_87"))
    near = {"knee": "Knee", "ankle": "Ankle", "elbow": "Elbow", "wrist": "Wrist"}
    for joint, site in near.items():
        assert np.linalg.norm(ours[f"right_{joint}"] - published[f"R{site}"]) < 0.012
    # The knee lies between its condyles, the ankle inside the outer malleolus, the shoulder below the acromion.
    middle = (published["rknem"] + published["rinnerknee"]) / 2
    assert np.linalg.norm(ours["right_knee"] - middle) < 0.012
    assert published["rankm"][1] < ours["right_ankle"][1] - 0.02
    assert published["rshom"][1] < ours["right_shoulder"][1] - 0.02
    # The hip joint centre by the ASIS: 22 % of their distance behind, 30 % below, 36 % from the midline (Bell 1990).
    wide = np.linalg.norm(published["lasis"] - published["rasis"])
    bell = published["rasis"] * [1, 0, 1] + wide * np.array([-0.22, -0.36, -0.30])
    # Its error against X-rays is about 1 to 3 cm.
    assert np.linalg.norm(ours["right_hip"] - bell) < 0.035


def test_face_and_feet():
    x = neutral(marker_set("blazepose_33"))
    assert x["nose"][0] > x["left_eye"][0] > x["left_ear"][0]
    assert x["left_eye"][2] > x["nose"][2] > x["mouth_left"][2]
    assert 0.05 < x["left_eye"][1] - x["right_eye"][1] < 0.075
    assert 0.13 < x["left_ear"][1] - x["right_ear"][1] < 0.17
    assert 0.24 < x["right_foot_index"][0] - x["right_heel"][0] < 0.29
    assert neutral(marker_set("mpi_inf_3dhp_17"))["head_top"][2] == pytest.approx(1.79, abs=0.03)


def test_unknown_set_names_the_known_ones():
    with pytest.raises(PblError) as caught:
        marker_set("coco_17")
    assert caught.value.code == "MARKER_SET_UNKNOWN"
    assert all(name in caught.value.text() for name in MARKER_SETS)


def test_check_names():
    markers = marker_set("blazepose_33")
    names = BLAZEPOSE.split()
    markers.check_names(names)
    with pytest.raises(PblError, match="unknown: beak") as caught:
        markers.check_names(["beak", *names[1:]])
    assert caught.value.code == "MARKER_SET_UNKNOWN"
    assert "nose" in caught.value.found
    with pytest.raises(PblError, match="another order"):
        markers.check_names(names[::-1])
    with pytest.raises(PblError, match="MARKER_SET_UNKNOWN"):
        markers.check_names([*names, "nose"])


def test_a_labs_own_table(tmp_path):
    path = tmp_path / "our_lab.csv"
    path.write_text("# three markers\nname,body,x,y,z,who\nRASI,pelvis,0.01,0,0.13,me\n\nRHEE, calcn_r, 0,0.02,0,me\n")
    markers = load_marker_set(path)
    assert markers.name == "our_lab"
    assert markers.names == ("RASI", "RHEE")
    assert markers.body_names == ("pelvis", "calcn_r")
    np.testing.assert_array_equal(markers.position_m, [[0.01, 0, 0.13], [0, 0.02, 0]])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "no column name"),
        ("name,body,x,y\nA,pelvis,0,0\n", "no column z"),
        ("name,body,x,y,z\n", "no markers"),
        ("name,body,x,y,z\nA,pelvis,0,0,0\nA,pelvis,1,0,0\n", "line 3: marker A a second time"),
        ("name,body,x,y,z\n# c\nA,wing,0,0,0\n", "line 3: body 'wing'"),
        ("name,body,x,y,z\nA,pelvis,zero,0,0\n", "line 2: could not convert"),
        ("name,body,x,y,z\nA,pelvis,nan,0,0\n", "line 2: position"),
        ("name,body,x,y,z\nA,pelvis,10,0,130\n", "line 2: position"),
        ("name,body,x,y,z\nA,pelvis,0,0\n", "line 2: "),
        ("name,body,x,y,z\n,pelvis,0,0,0\n", "line 2: no name"),
        ("name,body,x,y,z,weight_3d\na,pelvis,0,0,0,2\n", "line 2: weight_3d"),
        (None, "No such file"),
    ],
)
def test_a_bad_table_is_refused(tmp_path, text, found):
    path = tmp_path / "bad.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(PblError) as caught:
        load_marker_set(path)
    assert caught.value.code == "FILE_FORMAT"
    assert found in caught.value.found


def test_only_the_large_joints_of_blazepose_count_in_3d():
    markers = marker_set("blazepose_33")
    large = ["shoulder", "elbow", "wrist", "hip", "knee", "ankle"]
    counted = {n for n, w in zip(markers.names, markers.weight_3d, strict=True) if w == 1}
    assert counted == {f"{s}_{j}" for s in ("left", "right") for j in large}
    assert set(markers.weight_3d) == {0.0, 1.0}
    assert np.all(marker_set("bml_movi_87").weight_3d == 1)


def test_a_table_may_weight_its_markers(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("name,body,x,y,z,weight_3d\na,pelvis,0,0,0,0.5\nb,pelvis,0,0,0.1,\n")
    np.testing.assert_array_equal(load_marker_set(path).weight_3d, [0.5, 1])
