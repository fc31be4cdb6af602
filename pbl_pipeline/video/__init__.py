"""Video files: probe, frames in order with their own time stamps, intrinsics, pose and orientation of the camera."""

from pbl_pipeline.results.video_facts import FirstPicture, VideoInfo

from .attitude import Attitude, camera_in_device, check_attitude, unknown_at
from .boards import Board
from .calibrate import Calibration, calibrate_video, draw_calibration
from .camera import (
    CameraPose,
    check_lens,
    guess_camera,
    load_camera,
    load_camera_poses,
    scaled_matrix,
    turning_radius2,
    undistort_px,
    viewing_ray,
)
from .clock import attitude_of, load_attitude
from .decode import check_file
from .file_facts import check_timing, packet_times, probe, read_first, read_metadata, recorded_utc
from .frames import read_frames
from .h264 import write_h264
from .kept import frames_kept, release_frames
from .lens_calibration import (
    LensCalibration,
    PhoneLens,
    about_phone,
    calibrated_camera,
    find_camera,
    load_lens_calibration,
    phone_lens,
    turned_camera,
)
from .phone_log import SENSORS, VIDEO_CLOCK, PhoneLog, Sensor
from .sensor_logger import read_phone_log
from .types import CAMERA_KINDS, Camera, Frame, cut_image
