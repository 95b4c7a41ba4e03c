"""How well corners are found and measured in rendered pictures."""

import numpy as np
import pytest

from calibration_scenes import CHARUCO, CHESSBOARD, SIZE, errors_px, render, shown
from tubesight.calibration.corners import Corners, continues_beyond
from tubesight.calibration.find import find_corners, turns
from tubesight.calibration.guided import guided_corners
from tubesight.calibration.scene import Scene
from tubesight.core import Board
from tubesight.geometry.pose import Pose


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=lambda b: b.type)
@pytest.mark.parametrize("spin_deg", [0, 100, 190, 275])
def test_corners_are_found_in_the_frame_of_the_formats(board: Board, spin_deg: float) -> None:
    seen_by, pose, picture = shown(board, 25, spin_deg)
    corners = find_corners(picture, board)
    assert corners is not None
    # The ChArUco detector may miss corners beside a marker it did not read.
    assert len(corners.ids) >= (0.8 if board is CHARUCO else 1.0) * len(board.corners_mm)
    # Finders are good to half a pixel; the next corner is 25 pixels away.
    assert errors_px(corners, board, seen_by, pose).max() < 1.0


@pytest.mark.parametrize("squares", [(7, 10), (9, 8), (9, 7), (8, 8), (7, 7)])
@pytest.mark.parametrize("spin_deg", [20, 110, 200, 290])
def test_ambiguous_boards_are_found_up_to_their_own_turns(squares: tuple[int, int], spin_deg: float) -> None:
    board = Board("chessboard", squares, 13.0)
    seen_by, pose, picture = shown(board, 15, spin_deg)
    corners = find_corners(picture, board)
    assert corners is not None
    errors = [errors_px(Corners(order[corners.ids], corners.px), board, seen_by, pose).max() for order in turns(board)]
    assert min(errors) < 1.0


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=lambda b: b.type)
@pytest.mark.parametrize("blur", [0.4, 0.8, 1.8])
def test_guided_corners_are_right_to_hundredths_of_a_pixel(board: Board, blur: float) -> None:
    rng = np.random.default_rng(4)
    errors = []
    for tilt in (10, 30, 45):
        seen_by, pose, _ = shown(board, tilt, 40 + tilt)
        picture = render(seen_by, board, pose, rng, blur=blur)
        # A first calibration projects corners half a pixel off: 1 mrad at 640 pixels.
        guess = Pose.from_rotvec(rng.normal(0, 6e-4, 3), rng.normal(0, 0.02, 3)) @ pose
        scene = Scene({"a": seen_by.camera}, {"a": guess}, {"v": Pose.identity()})
        measured = guided_corners(picture, board, scene, "a", "v", None)
        assert measured is not None
        assert len(measured.ids) == len(board.corners_mm)
        errors.append(errors_px(measured, board, seen_by, pose))
    # Noise of 2 levels on edges of 130 over about 400 pixels gives 0.01 px; blur and sampling add as much.
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.04


def test_guided_corners_leave_out_what_is_covered() -> None:
    seen_by, pose, picture = shown(CHESSBOARD, 20, 30)
    truth = seen_by.camera.project(pose.apply(CHESSBOARD.corners_mm))
    x, y = truth[20].astype(int)
    picture[y - 40 : y + 40, x - 40 : x + 40] = 90
    covered = (np.abs(truth - (x, y)) < 36).all(1)
    scene = Scene({"a": seen_by.camera}, {"a": pose}, {"v": Pose.identity()})
    measured = guided_corners(picture, CHESSBOARD, scene, "a", "v", None)
    assert measured is not None
    assert not set(np.flatnonzero(covered)) & set(measured.ids)
    assert len(measured.ids) >= len(truth) - 16
    # At the edge of the cover corners are half hidden, and still within half a pixel or refused.
    assert errors_px(measured, CHESSBOARD, seen_by, pose).max() < 0.5


def test_partly_visible_charuco_boards_are_found() -> None:
    seen_by, pose, picture = shown(CHARUCO, 20, 15)
    picture[:, : SIZE[0] // 2] = 60
    corners = find_corners(picture, CHARUCO)
    assert corners is not None
    assert 6 <= len(corners.ids) < len(CHARUCO.corners_mm)
    assert errors_px(corners, CHARUCO, seen_by, pose).max() < 1.0


@pytest.mark.parametrize("squares", [(9, 6), (9, 5), (7, 6)])
def test_a_smaller_charuco_board_is_recognised_as_part_of_a_larger(squares: tuple[int, int]) -> None:
    _, _, picture = shown(CHARUCO, 15, 20)
    board = Board("charuco", squares, 14.0, 10.0, "DICT_4X4_50")
    corners = find_corners(picture, board)
    if corners is None:
        assert squares[0] != CHARUCO.squares[0], "the markers of whole rows have the same numbers"
        return
    assert continues_beyond(picture, board, corners) is (squares != CHARUCO.squares)


def test_a_board_does_not_go_on_beyond_its_edge() -> None:
    for tilt in (0, 20, 40):
        _, _, picture = shown(CHESSBOARD, tilt, 70)
        corners = find_corners(picture, CHESSBOARD)
        assert corners is not None
        assert not continues_beyond(picture, CHESSBOARD, corners)


def test_a_grid_cut_out_of_a_board_goes_on() -> None:
    seen_by, pose, picture = shown(CHESSBOARD, 30, 70)
    part = Board("chessboard", (8, 6), 13.0)
    grid = seen_by.camera.project(pose.apply(CHESSBOARD.corners_mm)).reshape(6, 9, 2)
    for rows, columns in ((slice(0, 5), slice(0, 7)), (slice(1, 6), slice(2, 9))):
        corners = Corners(np.arange(35), grid[rows, columns].reshape(-1, 2))
        assert continues_beyond(picture, part, corners)
