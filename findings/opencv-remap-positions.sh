#!/usr/bin/env bash
# cv2.remap of OpenCV 4 rounds positions to 1/32 pixel; OpenCV 5 does not, but its cv2.undistort still does.
#
# Seen 2026-11-28: opencv-python-headless 4.14.0.94 and 5.0.0.93.
# Behaviour: measured on a ramp whose value is its column, as floats: INTER_LINEAR at column 10.01 returns 10.0 with
#   OpenCV 4 and 10.01 with 5, and warpAffine the same. cv2.undistort, which is documented as initUndistortRectifyMap
#   with remap, is off by up to 1/64 pixel with both, so that in OpenCV 5 the two no longer agree.
# Matters: pixels change with the major version, by an amount that is seen in tests that compare pictures, in optical
#   flow and in sub-pixel registration. Use the map with remap, not undistort.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install --into four opencv-python-headless==4.14.0.94 numpy==2.4.6
install --into five opencv-python-headless==5.0.0.93 numpy==2.4.6
cat >measure.py <<'PY'
import cv2, numpy as np

size = (640, 480)
ramp = np.tile(np.arange(size[0], dtype=np.float32), (size[1], 1))
column, row = np.meshgrid(np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32))
near = cv2.remap(ramp, column + np.float32(0.01), row, cv2.INTER_LINEAR)[240, 10]
shift = np.array([[1, 0, 0.01], [0, 1, 0]])
warped = cv2.warpAffine(ramp, shift, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)[240, 10]
camera, distortion = np.array([[1000, 0, 320], [0, 1000, 240], [0, 0, 1.0]]), np.array([-0.2, 0.05, 0, 0, 0])
x, y = cv2.initUndistortRectifyMap(camera, distortion, None, camera, size, cv2.CV_32FC1)
inside = (x > 1) & (x < size[0] - 2) & (y > 1) & (y < size[1] - 2)
off = [np.abs(picture - x)[inside].max() for picture in (
    cv2.remap(ramp, x, y, cv2.INTER_LINEAR), cv2.undistort(ramp, camera, distortion))]
print(f"OpenCV {cv2.__version__[0]}: remap at 10.01 is {near:.2f}, warpAffine {warped:.2f}; "
      f"largest error of remap {off[0]:.3f}, of undistort {off[1]:.3f} pixels")
PY
observe four <measure.py
observe five <measure.py
expect <<'SEEN'
OpenCV 4: remap at 10.01 is 10.00, warpAffine 10.00; largest error of remap 0.016, of undistort 0.016 pixels
OpenCV 5: remap at 10.01 is 10.01, warpAffine 10.01; largest error of remap 0.000, of undistort 0.016 pixels
SEEN
