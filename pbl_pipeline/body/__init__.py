"""The 40-degree-of-freedom body: model, marker sets, scaling and forward kinematics.

Frames: the body frames are OpenSim's (x forward, y up, z right), the world has z up; at `qpos = 0` the body stands
upright and looks along world +x, with its right side towards world -y.
"""

from pbl_pipeline import jax_setup

# Before anything below makes an array: JAX reads the cache's folder once.
jax_setup.configure()

from pbl_pipeline.body._capsules import (  # noqa: E402
    BodyFrames,
    Capsules,
    CapsuleShapes,
    body_frames,
    capsule_shapes,
    capsules,
    ray_lengths,
    scaled_model,
    stature_m,
)
from pbl_pipeline.body._chain import (  # noqa: E402
    Frames,
    chain_frames,
    mjx_frames,
)
from pbl_pipeline.body._kinematics import (  # noqa: E402
    MarkerJacobian,
    Points,
    body_poses,
    body_turns,
    marker_jacobian,
    marker_positions,
    scale_multipliers,
)
from pbl_pipeline.body._markers import MARKER_SETS, MarkerSet, load_marker_set, marker_set  # noqa: E402
from pbl_pipeline.body.model import (  # noqa: E402  # noqa: E402
    PELVIS_TURNS,
    SCALE_NAMES,
    SLIDES,
    Y_UP_TO_Z_UP,
    Body,
    angle_of,
    joint_angles,
    joint_angles_sd,
    joint_of,
    load_body,
)
