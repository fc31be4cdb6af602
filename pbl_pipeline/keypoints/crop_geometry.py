"""From the axes of a picture's crop to the camera frame.

A network that sees a crop does not know where in the picture it was cut. Except for a slight stretch, the crop is
the picture of a camera that looks straight at the crop's centre and is rolled with the crop. Its 3D points stand in
that virtual camera's frame. A person at the edge of a wide picture is seen at up to 30 degrees from the optical axis,
and without this rotation would seem to turn while she walks straight on.
"""

from __future__ import annotations

import numpy as np

from pbl_pipeline.video import Camera, viewing_ray


def crop_matrix(roi_px: np.ndarray, size: int) -> np.ndarray:
    """(2, 3) matrix from continuous crop coordinates (0..size, from the crop's edge) to picture pixels.

    `roi_px` (4,): centre x, centre y, side, rotation (rad, clockwise in the picture).
    """
    x, y, side, rotation = roi_px
    cosine, sine = np.cos(rotation), np.sin(rotation)
    turn = np.array([[cosine, -sine], [sine, cosine]]) * (side / size)
    return np.column_stack([turn, np.array([x, y]) - turn @ [size / 2, size / 2]])


def view_rotation(roi_px: np.ndarray, camera: Camera) -> np.ndarray:
    """(3, 3) rotation from the axes of the crop's virtual camera to the camera frame.

    The virtual camera looks along the ray through the crop's centre; its down axis is seen in the picture as the
    crop's down direction. At the principal point it is the crop's roll alone.
    """
    centre = np.asarray(roi_px[:2], np.float64)
    down_px = np.array([-np.sin(roi_px[3]), np.cos(roi_px[3])])
    ray, below = viewing_ray(np.stack([centre, centre + down_px]), camera)
    z = ray / np.linalg.norm(ray)
    y = (below - ray) - z * (z @ (below - ray))
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])
