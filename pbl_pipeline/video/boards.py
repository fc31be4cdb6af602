"""Boards for calibrating a camera: chessboards, and ChArUco boards, whose white squares hold markers."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import cv2
import numpy as np

from pbl_pipeline.errors import PblError

CHECKERBOARD, CHARUCO = "checkerboard", "charuco"
KINDS = (CHECKERBOARD, CHARUCO)
DEFAULT_DICTIONARY = "DICT_5X5_100"
#: Corners of a ChArUco board that must be seen in one picture: fewer constrain the lens too little.
_FEWEST_CORNERS = 8
_usage = functools.partial(PblError, "USAGE", next_step="measure the printed board and pass its figures")


@dataclasses.dataclass(frozen=True)
class Board:
    """A flat board.

    Raises `PblError` USAGE: an unknown kind or dictionary, a board too small, sizes that are not positive.
    """

    kind: str
    squares: tuple[int, int]  # along and across; there is one inner corner less
    square_mm: float  # measured on the print
    # Of a ChArUco board only:
    marker_mm: float | None = None  # side of a marker, by default three quarters of a square
    dictionary: str = DEFAULT_DICTIONARY  # family of the markers, OpenCV's name
    legacy: bool = False  # the pattern that OpenCV before 4.6 printed for an even number of rows

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise _usage(f"board {self.kind!r}", f"one of {', '.join(KINDS)}")
        if min(self.squares) < 4 or max(self.squares) > 50:
            raise _usage(f"a board of {self.squares[0]}x{self.squares[1]} squares", "4 to 50 squares along each side")
        if not 0 < self.square_mm < math.inf:
            raise _usage(f"squares of {self.square_mm:g} mm", "the measured side of a square, in mm")
        if self.kind == CHARUCO:
            if not 0 < self.marker < self.square_mm:
                raise _usage(f"markers of {self.marker:g} mm", f"a side below the square's {self.square_mm:g} mm")
            if self.dictionary not in dictionaries():
                raise _usage(f"dictionary {self.dictionary!r}", f"one of {', '.join(dictionaries())}")
            held = len(self._dictionary().bytesList)
            needed = self.squares[0] * self.squares[1] // 2
            if needed > held:
                raise _usage(f"a board of {needed} markers with {self.dictionary}", f"at most its {held} markers")

    @property
    def marker(self) -> float:
        """Side of a marker, mm."""
        return 0.75 * self.square_mm if self.marker_mm is None else self.marker_mm

    @property
    def corners_m(self) -> np.ndarray:
        """(N, 3) inner corners in the board's plane, row by row, m; the first at the origin."""
        along, across = (n - 1 for n in self.squares)
        grid = np.stack(np.meshgrid(np.arange(along), np.arange(across)), axis=-1).reshape(-1, 2)
        return np.column_stack([grid, np.zeros(len(grid))]) * self.square_mm / 1000

    def find(self, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Find the board in a picture (H, W) uint8: numbers (K,) and positions (K, 2) px of the corners seen, or None.

        A chessboard is found whole or not at all; of a ChArUco board a part is enough.
        """
        if self.kind == CHECKERBOARD:
            size = (self.squares[0] - 1, self.squares[1] - 1)
            found, corners = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
            return (np.arange(size[0] * size[1]), corners.reshape(-1, 2).astype(np.float64)) if found else None
        corners, ids, _, _ = _detector(self).detectBoard(grey)
        if ids is None or len(ids) < _FEWEST_CORNERS:
            return None
        ids = np.asarray(ids).ravel().astype(int)
        rows, columns = np.divmod(ids, self.squares[0] - 1)
        # Points on one line do not determine the tilt of the plane.
        if min(np.ptp(rows), np.ptp(columns)) == 0:
            return None
        return ids, np.asarray(corners, np.float64).reshape(-1, 2)

    def by_corners(self) -> Board | None:
        """The chessboard with this many inner corners, in case those were counted instead of the squares."""
        if self.kind != CHECKERBOARD:
            return None
        return dataclasses.replace(self, squares=(self.squares[0] + 1, self.squares[1] + 1))

    def picture(self, px_per_square: int) -> np.ndarray:
        """(H, W) uint8: the board as it is printed, without a margin."""
        along, across = self.squares
        if self.kind == CHARUCO:
            return self._charuco().generateImage((along * px_per_square, across * px_per_square), marginSize=0)
        dark = np.add.outer(np.arange(across), np.arange(along)) % 2 == 0
        return np.kron(np.where(dark, 0, 255), np.ones((px_per_square, px_per_square))).astype(np.uint8)

    def _dictionary(self) -> Any:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    def _charuco(self) -> Any:
        board = cv2.aruco.CharucoBoard(self.squares, self.square_mm, self.marker, self._dictionary())
        board.setLegacyPattern(self.legacy)
        return board


@functools.lru_cache(maxsize=4)
def _detector(board: Board) -> Any:
    return cv2.aruco.CharucoDetector(board._charuco())


def dictionaries() -> list[str]:
    """Names of the marker families that OpenCV knows."""
    return sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_") and n == n.upper())
