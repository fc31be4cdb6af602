"""The shipped pose prior is what `research.poses` makes of the recordings."""

import numpy as np
import pytest

from pbl_pipeline.fit.priors import learned_poses
from research.corpus.motions import read_motions
from research.corpus.walks import is_held_out
from research.poses import JOINTS, MIDDLE, learn, mirrored
from tests import SHARED

MOTIONS = SHARED / "real" / "motions"


@pytest.mark.long
@pytest.mark.skipif(not MOTIONS.is_dir(), reason="the recordings of other laboratories are not here")
def test_the_shipped_prior_made_again():
    made = learn([m for m in read_motions(MOTIONS) if not is_held_out(m.person)])
    shipped = learned_poses("people-3")
    assert made["persons"] == shipped["persons"]
    assert not any(map(is_held_out, shipped["persons"]))
    assert tuple(shipped["joints"]) == JOINTS
    for ours, theirs in zip(made["components"], shipped["components"], strict=True):
        np.testing.assert_allclose(ours["mean_deg"], theirs["mean_deg"], atol=0.01)
        np.testing.assert_allclose(ours["covariance_deg2"], theirs["covariance_deg2"], atol=0.1)


def test_left_and_right_are_alike_in_the_shipped_prior():
    for component in learned_poses("people-3")["components"]:
        mean, S = np.array(component["mean_deg"]), np.array(component["covariance_deg2"])
        np.testing.assert_allclose(mirrored(mean[None])[0], mean, atol=1e-3)
        turn = mirrored(np.eye(len(JOINTS)))
        np.testing.assert_allclose(turn @ S @ turn.T, S, atol=0.01)
        assert np.linalg.eigvalsh(S)[0] > 4.0  # no direction is held to less than 2 deg


def test_a_mirror_exchanges_the_sides_and_turns_what_is_sideways():
    pose = np.arange(len(JOINTS), dtype=float)[None] + 1
    seen = mirrored(pose)
    np.testing.assert_array_equal(mirrored(seen), pose)
    assert seen[0, JOINTS.index("hip_flexion_l")] == pose[0, JOINTS.index("hip_flexion_r")]
    assert seen[0, MIDDLE.index("pelvis_list")] == -pose[0, MIDDLE.index("pelvis_list")]
