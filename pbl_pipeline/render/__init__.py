"""The fitted body drawn over the recording."""

from pbl_pipeline.render.body_poses import BodyTrack, body_track, uncertain_sides
from pbl_pipeline.render.colours import SIDE_COLOUR, side_of
from pbl_pipeline.render.drawing import capsule_outline, draw_body, draw_keypoints
from pbl_pipeline.render.overlay import overlay_frames, render_overlay, report_indices
from pbl_pipeline.render.projection import NEAR_M, rotation_matrix, scaled_camera, to_camera, to_pixels, turning_radius2
from pbl_pipeline.render.skeleton import draw_skeleton, skeleton_lines
from pbl_pipeline.render.strip import stance_spans
