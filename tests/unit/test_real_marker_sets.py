"""Marker sets for real recordings: laboratory markers of two walks, OpenPose's points from four cameras.

The fits here take a little over a second of movement each, the least that is accepted; the commands
`research/benchmarks/{marker_ik,multiview}.py` print the whole of it.
"""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.body import marker_set
from pbl_pipeline.fit import METHODS, fit_session
from pbl_pipeline.keypoints import Keypoints, MultiView, WorldMarkers, ray_miss_m
from research.benchmarks import marker_ik, multiview
from tests.unit.test_body_markers import neutral

#: Computed by others from the same markers, so no observations.
NOT_MARKERS = {"L_HJC", "L_HJC_reg", "R_HJC", "R_HJC_reg"}
#: Plates and wands: they are where somebody put them.
CLUSTERS = ("thigh", "sh2", "sh3", "sh4", "shank_antsup", "humerus", "forearm")
WALK_FRAMES, BALANCE_FRAMES = slice(0, 110), slice(0, 70)  # at 100 and 60 Hz


@pytest.fixture
def walk(shared_data) -> WorldMarkers:
    return marker_ik.markers_of("walkingTI1", marker_ik.marker_table())


def is_cluster(name: str) -> bool:
    return any(c in name for c in CLUSTERS)


@pytest.mark.parametrize("name", marker_ik.WALKS)
def test_the_table_has_the_recordings_markers(shared_data, name):
    recorded = WorldMarkers.from_trc(marker_ik.FOLDER / f"{name}.trc", "marker_ik").names
    assert set(recorded) - set(marker_ik.marker_table().names) == NOT_MARKERS
    assert set(marker_ik.marker_table().names) <= set(recorded)


def test_landmarks_are_mirror_images():
    markers = marker_ik.marker_table()
    pairs = 0
    for i, name in enumerate(markers.names):
        side, rest = name[:2], name[2:]
        if side in ("L_", "L.") and not is_cluster(name):
            j = next(k for k, n in enumerate(markers.names) if n[0] in "rR" and n[2:] == rest)
            assert markers.body_names[j] == markers.body_names[i].replace("_l", "_r")
            np.testing.assert_array_equal(markers.position_m[j], markers.position_m[i] * [1, 1, -1])
            pairs += 1
    assert pairs == 13
    assert markers.position_m[markers.names.index("C7"), 2] == 0


def test_every_marker_is_on_its_own_side_and_near_its_bone():
    """A marker lies within 15 cm of the line of its segment; a side mixed up would lie 17 cm and more away."""
    markers = marker_ik.marker_table()
    for name, place in neutral(markers).items():
        if name != "C7":
            assert (place[1] > 0) == (name[0] == "L"), name  # left of a body that looks along +x is +y
    for name, body, (x, _, z) in zip(markers.names, markers.body_names, markers.position_m, strict=True):
        if body[:-2] in ("femur", "tibia", "humerus", "radius", "ulna"):
            assert np.hypot(x, z) < 0.15, name


def test_landmarks_lie_near_the_published_sites():
    """Skin markers of the same landmarks in the set BML-MoVi, on this body; palpation differs by 1 to 3 cm."""
    ours, published = neutral(marker_ik.marker_table()), neutral(marker_set("bml_movi_87"))
    sites = {"C7": "backneck", "r.ASIS": "rasis", "r.PSIS": "rpsis", "r_knee": "rknem", "r_ankle": "rankm"}
    sites |= {"r_calc": "RHeel", "r_5meta": "rfifthmetatarsal", "R_elbow_lat": "relbm", "R_elbow_med": "relbinner"}
    for name, site in sites.items():
        assert np.linalg.norm(ours[name] - published[site]) < 0.04, name


def test_body25b_lies_near_blazepose():
    """Where both detectors name the same point they mean the same place, to the centimetres by which they differ."""
    ours, other = neutral(marker_set("body25b")), neutral(marker_set("blazepose_33"))
    joints = ("Eye", "Ear", "Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle", "Heel")
    for side, long in (("L", "left"), ("R", "right")):
        for joint in joints:
            assert np.linalg.norm(ours[side + joint] - other[f"{long}_{joint.lower()}"]) < 0.03, joint
        # The feet end in the big toe inside and the little toe outside.
        assert abs(ours[f"{side}BigToe"][1]) < abs(ours[f"{side}SmallToe"][1])


def test_mot_files_are_read_in_degrees(shared_data):
    """One expert wrote radians, the other degrees: their knees are the same movement."""
    first, second = (marker_ik.expert_angles(marker_ik.FOLDER / f"walking1_ik_{e}.mot") for e in marker_ik.EXPERTS)
    found = marker_ik.agreement(first, second)
    for name in marker_ik.JUDGED:
        assert found[name].r > 0.99
        assert abs(found[name].offset_deg) < 10
        assert np.ptp(first[1][name]) > 30


def test_four_cameras_see_one_person(shared_data):
    """The calibration fits the points: the rays of the four views to the points meet within 3 cm at the median."""
    assert ray_miss_m(multiview.multi_view()).max() < 0.03


@pytest.mark.slow
@pytest.mark.usefixtures("little_optimised")
def test_a_second_of_walking_from_laboratory_markers(walk):
    """The issue's bars, on a walk whose cluster places were estimated from the other one."""
    xyz, confidence = walk.xyz_world_m[WALK_FRAMES], walk.confidence[WALK_FRAMES]
    part = WorldMarkers(walk.time_s[WALK_FRAMES], walk.names, walk.marker_set, xyz, confidence)
    table = marker_ik.marker_table()
    fit = fit_session([part], ["walkingTI1"], METHODS["markers"], markers=table).trials[0]
    assert marker_ik.marker_rms_mm(fit, part) <= marker_ik.MAX_RMS_MM
    for expert in marker_ik.EXPERTS:
        theirs = marker_ik.expert_angles(marker_ik.FOLDER / f"walkingTI1_ik_{expert}.mot")
        found = marker_ik.agreement(marker_ik.fitted_angles(fit), theirs)
        assert [n for n in marker_ik.JUDGED if not found[n].passed] == []


@pytest.mark.long
@pytest.mark.slow
def test_a_second_of_balancing_from_four_cameras(shared_data):
    trial = multiview.multi_view()
    part = MultiView(tuple(cut(view) for view in trial.views), trial.poses)
    fit = fit_session([part], ["balancing"], METHODS["blazepose"]).trials[0]
    views = zip(part.views, part.poses, strict=True)
    distance = np.stack([multiview.reprojection_px(fit, view, pose) for view, pose in views])
    assert np.nanmedian(distance) <= multiview.MAX_MEDIAN_PX


def cut(view: Keypoints) -> Keypoints:
    fields = ("time_s", "xy_px", "xyz_cam_m", "confidence", "box_px")
    return dataclasses.replace(view, **{f: getattr(view, f)[BALANCE_FRAMES] for f in fields})
