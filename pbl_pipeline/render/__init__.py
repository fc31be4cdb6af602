"""The fitted body drawn over the recording."""

from pbl_pipeline.render._draw import capsule_outline, draw_body, draw_keypoints
from pbl_pipeline.render._overlay import overlay_frames, render_overlay, report_indices
from pbl_pipeline.render._project import NEAR_M, rotation_matrix, scaled_camera, to_camera, to_pixels, turning_radius2
from pbl_pipeline.render._skeleton import draw_skeleton, skeleton_lines
from pbl_pipeline.render._strip import stance_spans
from pbl_pipeline.render._style import SIDE_COLOUR, side_of
from pbl_pipeline.render._track import BodyTrack, body_track, uncertain_sides

__all__ = [
    "NEAR_M",
    "SIDE_COLOUR",
    "BodyTrack",
    "body_track",
    "capsule_outline",
    "draw_body",
    "draw_keypoints",
    "draw_skeleton",
    "overlay_frames",
    "render_overlay",
    "report_indices",
    "rotation_matrix",
    "scaled_camera",
    "side_of",
    "skeleton_lines",
    "stance_spans",
    "to_camera",
    "to_pixels",
    "turning_radius2",
    "uncertain_sides",
]
