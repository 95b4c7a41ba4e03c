"""Calibration from rendered pictures to a rig: other boards, cameras and angles than the mock-up's."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from calibration_scenes import CHARUCO, CHESSBOARD, SIZE, TARGET, Stage, eye, facing, render, stage, volume_mm
from tubesight.calibration.calibrate import Calibration, calibrate
from tubesight.calibration.quality import assess, judge
from tubesight.calibration.record import Past
from tubesight.calibration.registration import Registration, register_views
from tubesight.calibration.scene import rms
from tubesight.core import Board, Image, InputError

Loaders = dict[str, dict[str, Callable[[], Image]]]


def known(pictures: Loaders, views: list[str]) -> Loaders:
    return {c: {v: own[v] for v in views} for c, own in pictures.items()}


def both(shown: Stage, pictures: Loaders, views: int) -> tuple[Calibration, Registration]:
    """Calibrate from the first views and register from the others, whose poses are given."""
    names = list(shown.poses)
    made = calibrate(known(pictures, names[:views]), shown.board)
    past = Past(shown.board, made.adjusted.observations, made.lens)
    rest = names[views:]
    return made, register_views(made.rig, past, known(pictures, rest), {v: shown.poses[v] for v in rest}, shown.board)


# Corners are measured to 0.02 px: at 640 px and 300 mm a triangulated point is good to 0.01 mm where the boards were.
# The volume reaches twice as far from its middle as they, where the lens is extrapolated from 8 to 10 views.
LIMIT_MM = 0.05


def test_charuco_of_non_square_pixels_partly_visible() -> None:
    eyes = [eye(640.0, 560.0), eye(650.0, 575.0, (-0.11, 0.04, 0.0002, -0.0003, 0.0))]
    # Near, so that many boards leave the picture in part.
    shown = stage(CHARUCO, [-35, 35], eyes, 12, seed=1, distance_mm=190.0)
    made, registered = both(shown, shown.pictures(), 10)
    assert any(len(o.px) < len(CHARUCO.corners_mm) for o in made.adjusted.observations), "no board was partial"
    for name, names in made.lens.items():
        assert "fy" in names
        matrix, true = registered.rig.cameras[name].matrix, shown.rig.cameras[name].matrix
        # Known to about 0.1 px; half a pixel is 5 deviations.
        assert np.abs((matrix - true)[[0, 1], [0, 1]]).max() < 0.5
    assert registered.exact
    assert registered.rig.registered
    assert volume_mm(registered.rig, shown.rig).max() < LIMIT_MM


@cache
def three() -> tuple[Stage, Loaders]:
    """Three cameras, the third turned by 115 degrees about its axis; a board that looks alike when turned."""
    board = Board("chessboard", (9, 7), 13.0)
    shown = stage(board, [-45, 0, 45], [eye(), eye(650.0, 650.0), eye()], 10, 3, 280.0, rolls_rad=(0.0, 0.2, 2.0))
    return shown, shown.pictures()


@cache
def three_solved() -> tuple[Calibration, Registration]:
    return both(*three(), 8)


def test_three_cameras_agree_on_which_corner_of_a_symmetric_board_is_which() -> None:
    made, _ = three_solved()
    assert made.warnings
    # A board taken for a turned one would be off by its size, 100 mm.
    assert volume_mm(made.rig, three()[0].rig, aligned=True).max() < LIMIT_MM


def test_three_cameras_are_registered_from_a_symmetric_board() -> None:
    made, registered = three_solved()
    assert volume_mm(registered.rig, three()[0].rig).max() < LIMIT_MM
    assert rms(registered.residuals_px) < 2 * made.adjusted.rms_px + 0.02
    assert max(registered.deviation_mm.values()) < 0.02


def test_cameras_125_degrees_apart_see_the_board_obliquely() -> None:
    eyes = [eye(), eye(650.0, 650.0, (-0.12, 0.06, -0.0005, 0.0003, 0.0))]
    shown = stage(CHESSBOARD, [-62, 63], eyes, 12, seed=1, tilt_deg=20.0)
    made, registered = both(shown, shown.pictures(), 10)
    # Boards that one finder misses are measured where the other camera places them.
    assert all(q.views >= 9 for q in assess(made.rig, made.adjusted).cameras.values())
    assert volume_mm(registered.rig, shown.rig).max() < LIMIT_MM


def test_a_wide_lens_with_strong_distortion() -> None:
    k = (-0.30, 0.09, 0.0005, -0.0003, 0.0)
    shown = stage(CHESSBOARD, [-40, 40], [eye(350.0, 350.0, k), eye(360.0, 360.0, k)], 12, 2, 170.0, spread_mm=45.0)
    _, registered = both(shown, shown.pictures(), 10)
    assert volume_mm(registered.rig, shown.rig).max() < LIMIT_MM


def test_one_camera_alone() -> None:
    shown = stage(CHESSBOARD, [0], [eye()], 10, seed=4)
    made, registered = both(shown, shown.pictures(), 8)
    true = shown.rig
    assert made.rig.base_frame == "left"
    assert abs(made.rig.cameras["left"].matrix[0, 0] - true.cameras["left"].matrix[0, 0]) < 0.5
    points = TARGET + np.random.default_rng(0).uniform(-50, 50, (50, 3))
    off = registered.rig.project("left", points) - true.project("left", points)
    # The pose is known as well as the board's corners, 0.02 px; 0.1 px allows for the volume around the boards.
    assert np.abs(off).max() < 0.1
    quality = assess(made.rig, made.adjusted)
    assert quality.pairs == ()
    assert np.isnan(quality.point_sd_mm)
    assert judge(quality, False).level == "good"
    assert "only 8 views" in judge(quality, False).remarks[0]


def only_left(shown: Stage, views: int) -> Stage:
    """The stage with more views, turned to the left camera so that the right one looks at the board's edge or back."""
    rng = np.random.default_rng(9)
    viewer = shown.rig.centre_mm("left")
    away = viewer + 3 * (shown.rig.centre_mm("left") - shown.rig.centre_mm("right"))
    extra = {
        f"x{i}": facing(shown.board, TARGET, 0.5 * (viewer + away), 20, 360 * i / views, rng) for i in range(views)
    }
    return Stage(shown.rig, shown.eyes, shown.board, shown.poses | extra, shown.seed)


def test_views_of_one_camera_alone_serve_its_lens() -> None:
    shown = only_left(stage(CHESSBOARD, [-45, 45], [eye(), eye(650.0, 650.0)], 8, seed=6), 4)
    made = calibrate(shown.pictures(), CHESSBOARD)
    seen = {name: {o.view for o in made.adjusted.observations if o.camera == name} for name in ("left", "right")}
    alone = seen["left"] - seen["right"]
    assert alone & {"x0", "x1", "x2", "x3"}
    assert {x.camera for x in made.left_out} == {"right"}


def test_a_board_that_moved_between_the_cameras_serves_the_lenses_only() -> None:
    shown = stage(CHESSBOARD, [-40, 40], [eye(), eye(650.0, 650.0)], 9, seed=7)
    pictures = shown.pictures()
    names = list(shown.poses)
    # The right camera's picture of view 2 is that of another moment.
    other = stage(CHESSBOARD, [-40, 40], [eye(), eye(650.0, 650.0)], 9, seed=8)
    picture = other.picture("right", names[4])
    pictures["right"][names[2]] = lambda: picture
    made = calibrate(pictures, CHESSBOARD)
    moved = {(x.camera, x.view) for x in made.left_out if "moved" in x.reason}
    assert moved == {("left", names[2]), ("right", names[2])}
    assert made.adjusted.rms_px < 0.1
    assert volume_mm(made.rig, shown.rig, aligned=True).max() < LIMIT_MM


def test_a_picture_whose_board_is_wrong_is_left_out() -> None:
    shown = stage(CHESSBOARD, [0], [eye()], 9, seed=10)
    pictures = shown.pictures()
    names = list(shown.poses)
    # A board with squares longer one way: no pose of the right board explains it.
    stretched = Board("chessboard", (10, 7), 13.0)
    rng = np.random.default_rng(0)
    picture = render(eye(640.0, 720.0), stretched, shown.rig.camera_from_base["left"] @ shown.poses[names[3]], rng)
    pictures["left"][names[3]] = lambda: picture
    made = calibrate(pictures, CHESSBOARD)
    assert [(x.camera, x.view) for x in made.left_out] == [("left", names[3])]
    assert "px off" in made.left_out[0].reason


def test_cameras_without_a_common_view_are_refused() -> None:
    shown = stage(CHESSBOARD, [0, 5], [eye(), eye()], 8, seed=11)
    pictures = shown.pictures()
    names = list(shown.poses)
    blank = np.full(SIZE[::-1], 40, np.uint8)
    for i, name in enumerate(names):
        pictures["left" if i % 2 else "right"][name] = lambda: blank
    with pytest.raises(InputError, match="at the same time"):
        calibrate(pictures, CHESSBOARD)


def test_pictures_of_different_sizes_are_refused() -> None:
    shown = stage(CHESSBOARD, [0], [eye()], 5, seed=12)
    pictures = shown.pictures()
    last = list(shown.poses)[-1]
    pictures["left"][last] = lambda: np.zeros((500, 700), np.uint8)
    with pytest.raises(InputError, match="700 x 500"):
        calibrate(pictures, CHESSBOARD)


@pytest.mark.parametrize("count", [1, 3])
def test_too_few_views_are_refused(count: int) -> None:
    shown = stage(CHESSBOARD, [0], [eye()], count, seed=13)
    with pytest.raises(InputError, match="are needed"):
        calibrate(shown.pictures(), CHESSBOARD)


def test_pictures_without_a_board_are_refused_early() -> None:
    looked: list[str] = []

    def blank(name: str) -> Image:
        looked.append(name)
        return np.full(SIZE[::-1], 90, np.uint8)

    pictures = {c: {f"{i}": (lambda n=f"{c}{i}": blank(n)) for i in range(40)} for c in ("left", "right")}
    with pytest.raises(InputError, match="none of the 6 pictures"):
        calibrate(pictures, CHESSBOARD)
    assert len(looked) <= 8


def test_one_board_pose_many_times_is_no_good_calibration() -> None:
    shown = stage(CHESSBOARD, [0], [eye()], 1, seed=14)
    picture = shown.picture("left", "000")
    made = calibrate({"left": {f"{i}": lambda: picture for i in range(6)}}, CHESSBOARD)
    quality = assess(made.rig, made.adjusted)
    verdict = judge(quality, False)
    assert quality.rms_px < 0.1
    assert verdict.level != "good"
    assert any("focal length open" in r for r in verdict.remarks)
    # One tilted plane fixes the focal length to some 10 px; that six equal pictures are one has to show.
    assert quality.cameras["left"].sd["f"] > 3
