"""Drawing of the fitted body over the recording."""

from pbl_pipeline.render.body_poses import BodyTrack, body_track, uncertain_sides, without_jumps
from pbl_pipeline.render.drawing import (
    NEAR_M,
    SIDE_COLOUR,
    capsule_outline,
    draw_body,
    draw_keypoints,
    draw_skeleton,
    rotation_matrix,
    side_of,
    skeleton_lines,
    stance_spans,
    to_camera,
    to_pixels,
)
from pbl_pipeline.render.overlay import overlay_frames, render_overlay, report_indices
