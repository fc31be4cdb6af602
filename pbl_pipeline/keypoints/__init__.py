from ._types import Camera, Keypoints
