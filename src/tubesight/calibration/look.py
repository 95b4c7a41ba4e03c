"""What one picture shows of the board, and whether a pair of pictures adds to a calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from tubesight.calibration.corners import Corners, continues_beyond, sample, sample_share, steps
from tubesight.calibration.find import find_corners
from tubesight.calibration.quality import CELLS, CameraQuality
from tubesight.calibration.resection import camera_poses
from tubesight.core import Array, Board, Image
from tubesight.geometry.camera import Camera

# Edges wider than this (standard deviation, px) cost a tenth of a millimetre; sharp pictures have 0.5 to 1.2.
_SHARP_PX = 2.0
# Cameras that run freely take pictures up to 33 ms apart: a board that moves by this many pixels a second, in a picture
# 1920 wide, is then a third of a pixel elsewhere at worst.
_STILL_PX_PER_S, _STILL_WIDTH = 10.0, 1920
# Without times: the same between two pictures of a video at 8 pictures a second.
_STILL_PX = 1.2
# A pair adds something where it fills so many new cells of a camera's picture, or shows the board turned or larger by
# this much against every pair that is there.
_NEW_CELLS, _NEW_TURN_DEG, _NEW_SIZE = 2, 10.0, 1.2
# Enough: so many of the cells are filled (`calibrate` remarks on less), the board was turned through this angle and
# shown at sizes this far apart.
_COVERED, _TURNED_DEG, _SIZES = 0.3, 25.0, 1.2
# Pairs below which a calibration is not worth the try, and beyond which more of the same does not help.
FEW_PAIRS, _TIMES_WANTED = 6, 2
# Steepest profiles are sampled this finely.
_PROFILE = np.linspace(-1, 1, 41)
_PROFILE_MAX_PX = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One picture.

    Attributes
    ----------
    corners
        None where the board is not seen.
    blur_px
        Width of the board's edges as the sigma of a Gaussian.
    cells
        (rows, columns) corners in each cell of the picture.
    normal
        (3,) direction the board faces, in the camera's frame, for a guess of the focal length.
    side_px
        Square root of the board's area.
    """

    corners: Corners | None
    size_px: tuple[int, int]
    blur_px: float = float("nan")
    cells: Array = field(default_factory=lambda: np.zeros((CELLS[1], CELLS[0])))
    normal: Array = field(default_factory=lambda: np.full(3, np.nan))
    side_px: float = float("nan")

    @property
    def sharp(self) -> bool:
        """Whether the board's edges are sharp enough."""
        return self.blur_px <= _SHARP_PX


def look_at(image: Image, board: Board) -> Look:
    """Find the board in a picture and measure how it is seen."""
    gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    height, width = gray.shape
    corners = find_corners(gray, board)
    if corners is None or continues_beyond(gray, board, corners):
        return Look(None, (width, height))
    cells, _, _ = np.histogram2d(
        corners.px[:, 1], corners.px[:, 0], bins=(CELLS[1], CELLS[0]), range=((0, height), (0, width))
    )
    # Only changes of the direction count, so a guess of the focal length will do.
    matrix = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1.0]])
    poses = camera_poses(Camera(matrix, (width, height)), board.corners_mm[corners.ids], corners.px)
    normal = poses[0].rotation[:, 2] if poses else np.full(3, np.nan)
    right, down = (np.nanmean(v.reshape(-1, 2), axis=0) for v in steps(corners.grid(board)))
    square = abs(float(right[0] * down[1] - right[1] * down[0]))
    side = float(np.sqrt(square * board.squares[0] * board.squares[1]))
    return Look(corners, (width, height), edge_blur_px(gray, corners, board), cells, normal, side)


def edge_blur_px(gray: Image, corners: Corners, board: Board) -> float:
    """Width of the edges between the board's squares: ``fall / (sqrt(2 pi) steepest slope)``, median over the edges."""
    grid = corners.grid(board)
    _, down = steps(grid)
    middle = (grid[:, :-1] + grid[:, 1:]) / 2
    across, along = (down[:, :-1] + down[:, 1:]) / 2, grid[:, 1:] - grid[:, :-1]
    known = np.isfinite(middle).all(-1) & np.isfinite(across).all(-1)
    middle, across, along = middle[known], across[known], along[known]
    step = np.linalg.norm(across, axis=1)
    half = np.minimum(1.6 * sample_share(board) * step, _PROFILE_MAX_PX)
    unit = across / step[:, None]
    levels = sample(gray, middle[:, None] + (_PROFILE * half[:, None])[..., None] * unit[:, None])
    fifth = len(_PROFILE) // 5
    fall = np.abs(levels[:, :fifth].mean(1) - levels[:, -fifth:].mean(1))
    slope = np.abs(np.gradient(levels, axis=1)).max(1) / (half * (_PROFILE[1] - _PROFILE[0]))
    # The profile runs along the board's other side, which is not square to the edge in perspective.
    sine = np.abs(unit[:, 0] * along[:, 1] - unit[:, 1] * along[:, 0]) / np.linalg.norm(along, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        blur = sine * fall / (np.sqrt(2 * np.pi) * slope)
    blur = blur[np.isfinite(blur)]
    return float(np.median(blur)) if len(blur) else float("nan")


def motion_px(before: Look | None, now: Look) -> float:
    """Median distance the corners moved between two looks; infinite where one of them has none in common."""
    if before is None or before.corners is None or now.corners is None:
        return float("inf")
    _, i, j = np.intersect1d(before.corners.ids, now.corners.ids, return_indices=True)
    if not len(i):
        return float("inf")
    return float(np.median(np.linalg.norm(before.corners.px[i] - now.corners.px[j], axis=1)))


def is_still(moved_px: float, seconds: float, width_px: int) -> bool:
    """Whether a board that moved so far in that time is still; time NaN where it is not known."""
    scale = width_px / _STILL_WIDTH
    limit = _STILL_PX_PER_S * seconds if np.isfinite(seconds) and seconds > 0 else _STILL_PX
    return moved_px <= limit * scale


class Collection:
    """Pairs kept so far, what they cover, and what is lacking.

    Parameters
    ----------
    cameras
        Names.
    wanted
        Pairs to keep at least.
    """

    def __init__(self, cameras: Sequence[str], wanted: int) -> None:
        self.wanted = wanted
        self.looks: dict[str, list[Look]] = {name: [] for name in cameras}

    def __len__(self) -> int:
        return min(len(looks) for looks in self.looks.values())

    def add(self, looks: Mapping[str, Look]) -> None:
        """Keep a pair, or the looks of those cameras that see the board."""
        for name, look in looks.items():
            self.looks[name].append(look)

    def adds(self, looks: Mapping[str, Look]) -> bool:
        """Whether a pair in which every camera sees the board shows anything new."""
        return not len(self) or any(self._new(name, look) for name, look in looks.items())

    def _new(self, name: str, look: Look) -> bool:
        if int(((look.cells > 0) & (self.cells(name) == 0)).sum()) >= _NEW_CELLS:
            return True
        return all(
            _turn_deg(look.normal, other.normal) >= _NEW_TURN_DEG
            or max(look.side_px / other.side_px, other.side_px / look.side_px) >= _NEW_SIZE
            for other in self.looks[name]
        )

    def cells(self, name: str) -> Array:
        """(rows, columns) corners in the cells of one camera's picture, of all pairs kept."""
        return np.asarray(np.sum([look.cells for look in self.looks[name]] or [np.zeros((CELLS[1], CELLS[0]))], axis=0))

    def covered(self, name: str) -> CameraQuality:
        """Coverage of one camera, also in words."""
        return CameraQuality(len(self.looks[name]), float("nan"), self.cells(name), {})

    def turned_deg(self, name: str) -> float:
        """Largest angle between two directions of the board, of one camera."""
        normals = [look.normal for look in self.looks[name]]
        return max((_turn_deg(a, b) for a in normals for b in normals), default=0.0)

    def sizes(self, name: str) -> float:
        """Ratio of the largest to the smallest view of the board."""
        sides = [look.side_px for look in self.looks[name]]
        return max(sides) / min(sides) if sides else 1.0

    def lacking(self) -> list[str]:
        """Say what is still to do, the most useful first; empty where nothing is."""
        names = list(self.looks)
        todo = []
        if min(self.turned_deg(n) for n in names) < _TURNED_DEG:
            todo.append("tilt the board, to all sides")
        least = min(names, key=lambda n: self.covered(n).covered)
        if self.covered(least).covered < _COVERED:
            _, _, where = self.covered(least).coverage_words.partition(", none ")
            todo.append(f"{least}: show the board at {where or 'other places'}")
        if min(self.sizes(n) for n in names) < _SIZES:
            todo.append("show the board nearer and farther")
        if not todo and len(self) < self.wanted:
            todo.append("go on with other places and tilts")
        return todo

    @property
    def done(self) -> bool:
        """Whether more pairs would not help."""
        return (len(self) >= self.wanted and not self.lacking()) or len(self) >= _TIMES_WANTED * self.wanted


def _turn_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1)))) if np.isfinite(a @ b) else 0.0
