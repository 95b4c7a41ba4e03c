"""Photographs of boards: corners where the camera projects them, frames as the file formats define them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tubesight.core import Board
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate import Scene, board_views, rig_around
from tubesight.simulate.boards import _printed, board_outline, render_board
from tubesight.simulate.rays import Window
from tubesight.simulate.rigs import camera_pose

CHESS = Board("chessboard", (10, 7), 13.0)
CHARUCO = Board("charuco", (9, 6), 14.0, 10.0, "DICT_4X4_50")
QUIET = Scene(noise_levels=0, texture=0)
RIG = rig_around(size_px=(1280, 720))


def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def refined(image, start_px, window: int):
    start = np.array(start_px, np.float32, order="C").reshape(-1, 1, 2)
    return cv2.cornerSubPix(gray(image), start, (window, window), (-1, -1), (3, 100, 1e-5)).reshape(-1, 2)


def facing(camera: Camera, distance_mm: float, board: Board, tilt_rad: float = 0.0, roll_rad: float = 0.0) -> Pose:
    """Pose ``camera_from_board`` of a board before the camera, its middle on the axis."""
    middle = board_outline(board).mean(0)
    rotation = Pose.from_rotvec((tilt_rad, 0, 0), np.zeros(3)) @ Pose.from_rotvec((0, 0, roll_rad), np.zeros(3))
    return Pose(rotation.rotation, np.array([0, 0, distance_mm]) - rotation.rotation @ middle)


@pytest.mark.parametrize("distortion", [(0.058, -0.134, 5e-4, -5e-4, 0.044), (-0.35, 0.12, 0.0, 0.0, 0.0)])
@pytest.mark.parametrize("roll_deg", [3.0, 33.0])
# The windows hold nothing but their corner: half a square, and the margin around a marker.
@pytest.mark.parametrize(("board", "window"), [(CHESS, 15), (CHARUCO, 7)], ids=["chessboard", "charuco"])
def test_corners_are_where_they_are_projected(distortion, roll_deg: float, board: Board, window: int) -> None:
    camera = Camera(RIG.cameras["left"].matrix, (1280, 720), np.array(distortion))
    pose = facing(camera, 180.0, board, 0.25, np.radians(roll_deg))
    image = render_board(camera, Pose.identity(), board, pose, replace(QUIET, blur_px=2.0))
    expected = camera.project(pose.apply(board.corners_mm))
    error = refined(image, expected, window) - expected
    # cornerSubPix itself errs by 0.004 px rms on slanted and 0.012 px on nearly upright edges blurred by 2 px (by three
    # times as much on sharp ones); one edge of a corner drawn 0.05 px off would add 0.05 px.
    assert np.sqrt((error**2).mean()) < 0.016
    assert np.abs(error).max() < 0.05
    # 40 corners at 0.012 px: 0.002 px.
    assert np.abs(error.mean(0)).max() < 0.006


def test_pattern_against_brute_force() -> None:
    """Whiteness of each pixel against 12 x 12 rays through it."""
    name = "left"
    (view,) = board_views(RIG, CHESS, 1, np.random.default_rng(1))
    camera, pose = RIG.cameras[name], RIG.camera_from_base[name] @ view
    corner = np.rint(camera.project(pose.apply(CHESS.corners_mm[22]))).astype(int)
    window = Window(corner[1] - 12, corner[1] + 13, corner[0] - 12, corner[0] + 13)
    inverse = np.linalg.inv(np.stack([pose.rotation[:, 0], pose.rotation[:, 1], pose.translation_mm], -1))

    def on_board(pixels):
        uvw = camera.unproject(pixels) @ inverse.T
        return uvw[..., 0] / uvw[..., 2], uvw[..., 1] / uvw[..., 2]

    columns, rows = np.meshgrid(np.arange(window.left, window.right), np.arange(window.top, window.bottom))
    pixels = np.stack([columns, rows], -1).astype(float)
    counted = np.zeros(window.shape)
    steps = (np.arange(12) + 0.5) / 12 - 0.5
    for offset in np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2):
        x, y = (np.floor(v / CHESS.square_mm).astype(int) for v in on_board(pixels + offset))
        counted += (x + y) % 2 == 0
    error = _printed(*on_board(pixels), CHESS) - counted / 144
    # Counting errs by 1 / 24 along the grid, and 0.01 rms on the tenth of the pixels that hold an edge; where two edges
    # cross in a pixel the product of both shares is not their exact area.
    assert np.abs(error).max() < 0.06
    assert error.std() < 0.006
    assert abs(error.mean()) < 0.001


def test_chessboard_frame_runs_from_white_to_black() -> None:
    """Formats: x from the side whose corner squares are white to the side whose two are black, z away."""
    camera = RIG.cameras["left"]
    pose = facing(camera, 230.0, CHESS)
    image = gray(render_board(camera, Pose.identity(), CHESS, pose, QUIET))
    corner_squares = np.array([(x, y, 0.0) for x in (-0.5, 8.5) for y in (-0.5, 5.5)]) * CHESS.square_mm
    columns, rows = np.rint(camera.project(pose.apply(corner_squares))).astype(int).T
    white_left, white_left_too, black, black_too = image[rows, columns] > 100
    assert white_left and white_left_too and not black and not black_too
    # z away from the viewer: x to the right and y down in the picture.
    origin, x, y = camera.project(pose.apply(np.array([(0, 0, 0), (50.0, 0, 0), (0, 50.0, 0)])))
    assert x[0] > origin[0] and y[1] > origin[1]


def test_charuco_is_opencvs_board() -> None:
    """The detector finds every marker and corner, numbered as in OpenCV's own frame."""
    camera = RIG.cameras["left"]
    pose = facing(camera, 200.0, CHARUCO, 0.3, 0.4)
    image = gray(render_board(camera, Pose.identity(), CHARUCO, pose, QUIET))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(CHARUCO.squares, CHARUCO.square_mm, CHARUCO.marker_mm, dictionary)
    corners, ids, _, marker_ids = cv2.aruco.CharucoDetector(board).detectBoard(image)
    assert sorted(np.ravel(marker_ids)) == list(range(27))
    assert sorted(np.ravel(ids)) == list(range(len(CHARUCO.corners_mm)))
    np.testing.assert_allclose(board.getChessboardCorners(), CHARUCO.corners_mm, atol=1e-5)
    expected = camera.project(pose.apply(CHARUCO.corners_mm))[np.ravel(ids)]
    # The detector interpolates and refines in a small window: a tenth of a pixel; a wrong number would be 30 px.
    assert np.abs(corners.reshape(-1, 2) - expected).max() < 0.2


def test_sheet_is_blank_from_behind() -> None:
    camera = RIG.cameras["left"]
    front = facing(camera, 230.0, CHESS)
    back = Pose(front.rotation @ np.diag([1.0, -1.0, -1.0]), front.translation_mm)
    image = gray(render_board(camera, Pose.identity(), CHESS, back, replace(QUIET, vignetting=0)))
    columns, rows = np.rint(camera.project(back.apply(CHESS.corners_mm))).astype(int).T
    assert np.ptp(image[rows.min() : rows.max(), columns.min() : columns.max()]) < 3


def test_board_outside_the_picture_leaves_the_cloth() -> None:
    camera = RIG.cameras["left"]
    pose = Pose(np.eye(3), np.array([2000.0, 0, 300]))
    empty = render_board(camera, Pose.identity(), CHESS, Pose(np.eye(3), np.array([-2000.0, 0, 300])), QUIET)
    np.testing.assert_array_equal(render_board(camera, Pose.identity(), CHESS, pose, replace(QUIET, shadow=0)), empty)


@pytest.mark.parametrize("angle_deg", [20.0, 45.0, 90.0, 125.0])
def test_board_views_are_seen_by_both_cameras(angle_deg: float) -> None:
    rig = rig_around(angle_deg)
    poses = board_views(rig, CHESS, 12, np.random.default_rng(3))
    directions, places = [], []
    for pose in poses:
        for name in rig.names:
            assert rig.cameras[name].contains(rig.project(name, pose.apply(CHESS.corners_mm)), 10).all()
            # From the front: the board's z points away from the camera.
            assert pose.rotation[:, 2] @ (pose.translation_mm - rig.centre_mm(name)) > 0
        directions.append(pose.rotation[:, 2])
        places.append(pose.translation_mm)
    # Good to calibrate with: tilted by some degrees and spread over the working volume.
    assert np.linalg.norm(np.std(directions, axis=0)) > np.radians(5)
    assert np.std(places, axis=0).min() > 15


def test_cameras_too_far_apart_get_views_in_turn() -> None:
    rig = rig_around(175.0)
    poses = board_views(rig, CHESS, 4, np.random.default_rng(3))
    seen = [
        [n for n in rig.names if p.rotation[:, 2] @ (p.translation_mm - rig.centre_mm(n)) > 100 * np.cos(1.2)]
        for p in poses
    ]
    assert {n for names in seen for n in names} == set(rig.names)


def test_board_too_large_is_refused() -> None:
    with pytest.raises(ValueError, match="smaller board"):
        board_views(RIG, Board("chessboard", (10, 7), 90.0), 2, np.random.default_rng(0))


def test_rig_around_looks_at_the_tube_with_y_along_z() -> None:
    rig = rig_around(70.0, distance_mm=300.0, names=("a", "b", "c"))
    target = np.array([0.0, 0.0, 80.0])
    for i, name in enumerate(rig.names):
        camera, pose = rig.cameras[name], rig.camera_from_base[name]
        np.testing.assert_allclose(camera.project(pose.apply(target)), camera.matrix[:2, 2], atol=1e-9)
        np.testing.assert_allclose(pose.rotate((0.0, 0.0, 1.0)), (0, 1, 0), atol=1e-12)
        x, y, _ = rig.centre_mm(name)
        assert np.degrees(np.arctan2(y, x)) == pytest.approx(70.0 * i)
        assert np.hypot(x, y) == pytest.approx(300.0, rel=0.011)


def test_elevated_camera_stands_above_and_looks_down() -> None:
    pose = camera_pose(30.0, 400.0, (0.0, 0.0, 80.0), 25.0)
    centre = pose.inverse().translation_mm
    # The tube hangs along +z, so above is -z.
    assert centre[2] == pytest.approx(80 - 400 * np.sin(np.radians(25)))
    rig = Rig({"a": RIG.cameras["left"]}, {"a": pose})
    np.testing.assert_allclose(rig.project("a", np.array([0.0, 0, 80.0])), RIG.cameras["left"].matrix[:2, 2], atol=1e-9)
