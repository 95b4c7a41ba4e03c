"""The bundle adjustment as mathematics: Jacobian, recovery, covariance, outliers, lens selection."""

import numpy as np
import pytest

from calibration_scenes import CHESSBOARD, SIZE, Eye, Stage, eye, stage, volume_mm
from tubesight.calibration.bundle import Adjusted, adjust, covariance
from tubesight.calibration.correlation import design_effect
from tubesight.calibration.problem import Problem
from tubesight.calibration.scene import Free, Observation, Prior, Scene, with_lens
from tubesight.calibration.selection import BASE, select_lens
from tubesight.core import Array, Board
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

SPLIT = ("fx", "fy", *BASE[1:])
TRUE = stage(CHESSBOARD, [-35, 35], [eye(), eye(650.0, 650.0, (-0.12, 0.06, -0.0004, 0.0002, 0.0))], 10, seed=5)


def observed(
    true: Rig, poses: dict[str, Pose], board: Board, noise_px: float, rng: np.random.Generator
) -> list[Observation]:
    """Corners of all views in all cameras with independent noise."""
    made = []
    for camera in true.names:
        for view, pose in poses.items():
            px = true.project(camera, pose.apply(board.corners_mm))
            seen = true.cameras[camera].contains(px)
            px = px + rng.normal(0, noise_px, px.shape) if noise_px else px
            made.append(Observation(camera, view, board.corners_mm[seen], px[seen]))
    return made


def truth_scene() -> Scene:
    return Scene(TRUE.rig.cameras, TRUE.rig.camera_from_base, TRUE.poses)


def shaken(scene: Scene, rng: np.random.Generator) -> Scene:
    """A scene as a first guess has it: lenses 2 % off, poses 2 mm and 0.01 rad."""

    def shake(pose: Pose) -> Pose:
        return Pose.from_rotvec(rng.normal(0, 0.01, 3), rng.normal(0, 2, 3)) @ pose

    cameras = {n: with_lens(c, {"f": 12.0, "cx": 4.0, "cy": -3.0, "k1": 0.03}) for n, c in scene.cameras.items()}
    return Scene(
        cameras,
        {n: shake(p) for n, p in scene.camera_from_base.items()},
        {n: shake(p) for n, p in scene.base_from_view.items()},
    )


@pytest.mark.parametrize("names", [BASE, (*SPLIT, "k3", "skew")], ids=["one f", "all"])
def test_jacobian_agrees_with_differences(names: tuple[str, ...]) -> None:
    rng = np.random.default_rng(0)
    scene = shaken(truth_scene(), rng)
    observations = observed(TRUE.rig, TRUE.poses, CHESSBOARD, 0.1, rng)
    free = Free(dict.fromkeys(TRUE.rig.names, names), ("left", "right"), tuple(TRUE.poses))
    # A prior holds a view near the identity; far from it, its Jacobian is tested with a rotation of 2.5 rad.
    priors = (Prior(next(iter(TRUE.poses)), np.array([10.0, -5, 30]), 0.1, 2.0),)
    problem = Problem(scene, tuple(observations), free, priors)
    x = rng.normal(0, 1e-3, free.count)
    analytic = problem.jacobian(x).toarray()
    step = 1e-6
    first = len(free.rig_names)
    for j in [*range(first, first + 6), *rng.choice(free.count, 40, replace=False)]:
        d = np.zeros(free.count)
        d[j] = step
        numeric = (problem.residuals(x + d) - problem.residuals(x - d)) / (2 * step)
        # Central differences: rounding of 1e-13 px / 1e-6, curvature of order 1e-12 of the slope; a sign error is 2.
        assert np.abs(numeric - analytic[:, j]).max() < 1e-6 * max(1.0, np.abs(numeric).max())


def test_exact_corners_give_the_truth_from_a_rough_start() -> None:
    rng = np.random.default_rng(1)
    start = shaken(truth_scene(), rng)
    # The left camera is the gauge.
    true_left = TRUE.rig.camera_from_base["left"]
    start = Scene(start.cameras, {**start.camera_from_base, "left": true_left}, start.base_from_view)
    observations = observed(TRUE.rig, TRUE.poses, CHESSBOARD, 0.0, rng)
    solved = adjust(start, observations, Free(dict.fromkeys(TRUE.rig.names, BASE), ("right",), tuple(TRUE.poses)))
    assert solved.rms_px < 1e-4  # the loss is quadratic below a thousandth of a pixel
    rig = Rig(solved.scene.cameras, solved.scene.camera_from_base)
    assert volume_mm(rig, TRUE.rig).max() < 1e-3


def repeated(count: int, names: tuple[str, ...], noise_px: float = 0.1) -> list[Adjusted]:
    free = Free(dict.fromkeys(TRUE.rig.names, names), ("right",), tuple(TRUE.poses))
    return [
        adjust(truth_scene(), observed(TRUE.rig, TRUE.poses, CHESSBOARD, noise_px, np.random.default_rng(s)), free)
        for s in range(count)
    ]


def test_covariance_agrees_with_repetition() -> None:
    runs = repeated(32, BASE)
    squared = []
    for run in runs:
        found = covariance(run)
        assert found is not None
        assert len(found.names) == 20
        error = true_parameters(found.names, run.scene) - true_parameters(found.names)
        error[[n.endswith(("rx", "ry", "rz")) for n in found.names]] = relative_turn(run.scene)
        squared.append(error @ np.linalg.solve(found.matrix, error))
    # Normalised errors squared follow chi-squared with as many degrees of freedom as parameters, 20; the mean of 32
    # has a standard deviation of sqrt(2 * 20 / 32) = 1.1. Soft L1 costs 2 % of efficiency.
    assert 16.5 < np.mean(squared) < 24.0
    sigma = np.mean([r.sigma_px for r in runs])
    # Each view's pose takes 6 and the rig 20 of the 2160 residuals: less than 2 % of the noise.
    assert 0.095 < sigma < 0.105


def true_parameters(names: tuple[str, ...], scene: Scene | None = None) -> Array:
    """Parameters by name; rotations as 0."""
    scene = scene or truth_scene()
    values = []
    for full in names:
        camera, _, name = full.rpartition(".")
        c = scene.cameras[camera]
        m, k = c.matrix, dict(zip(("k1", "k2", "p1", "p2", "k3"), c.distortion, strict=True))
        t = dict(zip(("tx", "ty", "tz"), scene.camera_from_base[camera].translation_mm, strict=True))
        known = {"f": m[0, 0], "cx": m[0, 2], "cy": m[1, 2], "rx": 0.0, "ry": 0.0, "rz": 0.0} | k | t
        values.append(known[name])
    return np.array(values)


def relative_turn(scene: Scene) -> Array:
    """Small rotation from the true to the found pose of the right camera, applied on the left."""
    true = TRUE.rig.camera_from_base["right"].rotation
    return Pose(scene.camera_from_base["right"].rotation @ true.T, np.zeros(3)).rotvec_rad


def test_gross_outliers_do_little() -> None:
    rng = np.random.default_rng(2)
    observations = observed(TRUE.rig, TRUE.poses, CHESSBOARD, 0.05, rng)
    free = Free(dict.fromkeys(TRUE.rig.names, BASE), ("right",), tuple(TRUE.poses))
    clean = adjust(truth_scene(), observations, free)
    spoilt = []
    for o in observations:
        px = o.px.copy()
        px[rng.choice(len(px), 1)] += rng.normal(0, 15, 2)
        spoilt.append(Observation(o.camera, o.view, o.points_mm, px))
    robust = adjust(truth_scene(), spoilt, free)
    plain = adjust(truth_scene(), spoilt, free, robust=False)
    errors = [volume_mm(Rig(a.scene.cameras, a.scene.camera_from_base), TRUE.rig).max() for a in (clean, robust, plain)]
    # 2 % of the corners are 15 px off: least squares sees 2 px RMS instead of 0.05, soft L1 a bounded pull.
    assert errors[1] < 3 * errors[0] + 0.02
    assert errors[1] < 0.3 * errors[2]


def test_a_loose_observation_pulls_little() -> None:
    rng = np.random.default_rng(3)
    observations = observed(TRUE.rig, TRUE.poses, CHESSBOARD, 0.05, rng)
    first = observations[0]
    wrong = Observation(first.camera, first.view, first.points_mm, first.px + 1.0, sd_px=1000.0)
    free = Free(dict.fromkeys(TRUE.rig.names, BASE), ("right",), tuple(TRUE.poses))
    # At full weight a view wrong by a pixel moves the focal length by a tenth of a pixel and more; weighted by 1e-6 it
    # leaves what the solver's tolerance leaves.
    with_wrong = adjust(truth_scene(), [wrong, *observations[1:]], free)
    without = adjust(truth_scene(), observations[1:], free)
    assert abs(with_wrong.scene.cameras["left"].matrix[0, 0] - without.scene.cameras["left"].matrix[0, 0]) < 5e-3


def single(shown: Stage, noise_px: float, seed: int, bend_mm: float = 0.0) -> tuple[Scene, list[Observation]]:
    """The left camera's observations of its boards, each bent by its own amount."""
    rng = np.random.default_rng(seed)
    board = CHESSBOARD.corners_mm
    observations = []
    middle = board - board.mean(0)
    for view, pose in shown.poses.items():
        bend = bend_mm * rng.normal() * (middle[:, 0] ** 2 / 2000) + bend_mm * rng.normal() * (middle[:, 1] ** 2 / 900)
        px = shown.rig.project("left", pose.apply(board + np.outer(bend, [0, 0, 1])))
        observations.append(Observation("left", view, board, px + rng.normal(0, noise_px, px.shape)))
    scene = Scene({"left": shown.rig.cameras["left"]}, {"left": shown.rig.camera_from_base["left"]}, shown.poses)
    return scene, observations


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("bend_mm", [0.0, 0.5])
def test_a_plain_lens_keeps_one_focal_length_and_no_k3(seed: int, bend_mm: float) -> None:
    """Also where boards bend: such residuals are no noise, and an information criterion would overfit them."""
    assert select_lens(*single(TRUE, 0.05, seed, bend_mm)) == BASE


@pytest.mark.parametrize("ratio", [0.9, 0.995, 1.2])
def test_pixels_that_are_not_square_are_noticed(ratio: float) -> None:
    # Half a percent of 640 px is 3 px; the focal lengths are known to about 0.2 px each.
    shown = stage(CHESSBOARD, [0], [eye(640.0, 640.0 * ratio)], 10, seed=5)
    assert select_lens(*single(shown, 0.05, 0)) == SPLIT


def test_a_lens_with_k3_is_noticed() -> None:
    # Corners reach a radius of 0.9 from 190 mm: k3 = -0.04 moves them by 420 * 0.04 * 0.9^7 = 8 px, of which k1 and
    # k2 take up nine tenths.
    shown = stage(CHESSBOARD, [0], [eye(420.0, 420.0, (-0.25, 0.12, 0, 0, -0.04))], 12, 6, 190, spread_mm=60)
    assert select_lens(*single(shown, 0.05, 0)) == (*BASE, "k3")


def test_skew_is_noticed() -> None:
    matrix = np.array([[640, 1.5, 406], [0, 640, 295], [0, 0, 1]])
    shown = stage(CHESSBOARD, [0], [Eye(Camera(matrix, SIZE, np.array([-0.1, 0.05, 0, 0, 0])))], 10, seed=5)
    assert select_lens(*single(shown, 0.05, 0)) == (*BASE, "skew")


def test_a_bent_board_inflates_the_covariance() -> None:
    free = Free({"left": BASE}, (), tuple(TRUE.poses))
    flat, bent = (adjust(*single(TRUE, 0.05, 1, bend), free) for bend in (0.0, 0.5))
    # Independent corners: 1 within the scatter of 10 views x 7 dimensions, sqrt(2 / 70) = 0.17, three of which are 0.5.
    assert design_effect(flat, {"left": BASE}) < 1.5
    assert design_effect(bent, {"left": BASE}) > 2.0
