from ._types import VideoInfo, Frame
