"""Registration from points known in the base frame, and from inexact board poses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration_scenes import CHESSBOARD, TARGET, Stage, eye, stage, volume_mm
from tubesight.calibration.bundle import adjust
from tubesight.calibration.quality import assess
from tubesight.calibration.record import Past
from tubesight.calibration.registration import register_points, register_views
from tubesight.calibration.resection import camera_poses, resect
from tubesight.calibration.scene import Free, Observation, Scene
from tubesight.calibration.selection import BASE
from tubesight.core import Array, InputError
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

SHOWN = stage(CHESSBOARD, [-45, 45], [eye(), eye(650.0, 650.0)], 10, seed=21)
TRUE = SHOWN.rig
NAMES = [f"p{i}" for i in range(12)]
XYZ = TARGET + np.random.default_rng(3).uniform(-55, 55, (12, 3))


def seen(noise_px: float, seed: int = 0, xyz: Array = XYZ) -> dict[str, Array]:
    rng = np.random.default_rng(seed)
    return {c: TRUE.project(c, xyz) + rng.normal(0, noise_px, (len(xyz), 2)) for c in TRUE.names}


def calibrated(noise_px: float = 0.02) -> tuple[Rig, Past]:
    """A rig in the frame of its first camera, with the observations it came from."""
    rng = np.random.default_rng(1)
    observations = []
    for camera in TRUE.names:
        for view, pose in SHOWN.poses.items():
            px = TRUE.project(camera, pose.apply(CHESSBOARD.corners_mm))
            observations.append(
                Observation(camera, view, CHESSBOARD.corners_mm, px + rng.normal(0, noise_px, px.shape))
            )
    first = TRUE.camera_from_base["left"]
    poses = {n: p @ first.inverse() for n, p in TRUE.camera_from_base.items()}
    scene = Scene(TRUE.cameras, poses, {v: first @ p for v, p in SHOWN.poses.items()})
    solved = adjust(scene, observations, Free(dict.fromkeys(TRUE.names, BASE), ("right",), tuple(SHOWN.poses)))
    rig = Rig(solved.scene.cameras, solved.scene.camera_from_base, "left")
    return rig, Past(CHESSBOARD, tuple(observations), dict.fromkeys(TRUE.names, BASE))


def test_points_place_a_calibrated_rig_and_give_a_covariance() -> None:
    rig, past = calibrated()
    made = register_points(rig, past, NAMES, XYZ, seen(0.02))
    assert made.rig.registered
    assert made.exact
    assert made.rig.covariance is not None
    assert made.rig.covariance.names.count("left.rx") == 1
    # 12 points seen to 0.02 px at 2 px/mm fix the frame to 0.005 mm.
    assert volume_mm(made.rig, TRUE).max() < 0.04


def test_clicked_points_do_not_bend_the_lenses() -> None:
    rig, past = calibrated()
    exact, clicked = (register_points(rig, past, NAMES, XYZ, seen(n)) for n in (0.0, 0.5))
    assert not clicked.exact
    assert any("as measured" in w for w in clicked.warnings)
    for name in TRUE.names:
        # As much as the lens's own deviation, a tenth of a pixel; as exact points they would move it by pixels.
        assert np.abs(exact.rig.cameras[name].matrix - clicked.rig.cameras[name].matrix).max() < 0.15
    # 0.5 px at 2 px/mm over sqrt(12) points and two cameras is 0.05 mm, twice that at the edge of the volume.
    assert volume_mm(clicked.rig, TRUE).max() < 0.4
    quality = assess(clicked.rig, clicked.adjusted) if clicked.adjusted else None
    assert quality is not None
    assert 0.02 < quality.point_sd_mm < 0.3


def test_lenses_alone_are_placed_camera_by_camera() -> None:
    made = register_points(Rig(TRUE.cameras, {}, "left"), None, NAMES, XYZ, seen(0.0))
    assert volume_mm(made.rig, TRUE).max() < 1e-3
    assert made.rig.covariance is None


def test_relative_poses_that_are_known_are_kept() -> None:
    moved = Pose.from_rotvec([0.4, -1.0, 0.3], [50, -20, 400])
    rig = Rig(TRUE.cameras, {n: p @ moved for n, p in TRUE.camera_from_base.items()}, "left")
    few = seen(0.0)
    few["right"][4:] = np.nan
    few["left"][6:] = np.nan
    made = register_points(rig, None, NAMES, XYZ, few)
    assert volume_mm(made.rig, TRUE).max() < 1e-3
    relative = made.rig.relative_pose("right", "left").matrix
    assert relative == pytest.approx(rig.relative_pose("right", "left").matrix, abs=1e-9)


def test_one_camera_needs_six_points() -> None:
    rig = Rig({"left": TRUE.cameras["left"]}, {}, "left")
    px = {"left": seen(0.0)["left"]}
    made = register_points(rig, None, NAMES[:6], XYZ[:6], {"left": px["left"][:6]})
    # Six exact points: rounding of the solver.
    assert made.rig.camera_from_base["left"].matrix == pytest.approx(TRUE.camera_from_base["left"].matrix, abs=1e-4)
    with pytest.raises(InputError, match="at least 4 seen by two or 6 seen by one"):
        register_points(rig, None, NAMES[:5], XYZ[:5], {"left": px["left"][:5]})


@pytest.mark.parametrize("count", [1, 3])
def test_fewer_than_four_points_are_refused(count: int) -> None:
    px = {c: p[:count] for c, p in seen(0.0).items()}
    with pytest.raises(InputError, match=f"{count} are seen by two cameras"):
        register_points(TRUE, None, NAMES[:count], XYZ[:count], px)


@given(st.integers(0, 1000), st.floats(0, 1e-3))
@settings(max_examples=20, deadline=None)
def test_points_on_a_line_are_refused(seed: int, off_mm: float) -> None:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    line = TARGET + np.outer(np.linspace(-40, 40, 8), direction / np.linalg.norm(direction))
    line = line + rng.normal(0, off_mm, line.shape)
    with pytest.raises(InputError, match="on a line"):
        register_points(TRUE, None, NAMES[:8], line, seen(0.0, xyz=line))


def test_a_point_of_another_place_is_named() -> None:
    px = seen(0.05)
    px["right"][7] += (30, -12)
    made = register_points(TRUE, None, NAMES, XYZ, px)
    assert ["p7" in w and "right" in w for w in made.warnings] == [True]
    # Soft L1 bounds its pull: without it the frame would be off by 30 / 12 px, a millimetre.
    assert volume_mm(made.rig, TRUE).max() < 0.4


def test_points_of_a_strange_camera_or_outside_the_picture_are_refused() -> None:
    with pytest.raises(InputError, match="camera 'top'; the rig has left, right"):
        register_points(TRUE, None, NAMES, XYZ, {"top": seen(0.0)["left"]})
    px = seen(0.0)
    px["left"][2] = (4000, 10)
    with pytest.raises(InputError, match=r"'p2' lies outside the picture of left"):
        register_points(TRUE, None, NAMES, XYZ, px)


LENS = {
    "brown": (-0.1, 0.02, 1e-3, 0, 0),
    "rational": (0.1, 0, 0, 0, 0, 0.2, 0, 0),
    "equidistant": (-0.05, 0.01, 0, 0),
}


@given(
    st.integers(0, 10_000),
    st.sampled_from(["space", "plane", "four in space"]),
    st.sampled_from(list(LENS)),
)
@settings(max_examples=40, deadline=None)
def test_resection_finds_the_pose_of_any_camera(seed: int, kind: str, lens: str) -> None:
    rng = np.random.default_rng(seed)
    k = {
        "brown": (-0.1, 0.02, 1e-3, 0, 0),
        "rational": (0.1, 0, 0, 0, 0, 0.2, 0, 0),
        "equidistant": (-0.05, 0.01, 0, 0),
    }
    camera = Camera(np.array([[640, 2.0, 400], [0, 610, 300], [0, 0, 1]]), (800, 600), np.array(k[lens]), lens)
    points = rng.uniform(-50, 50, (4 if kind.startswith("four") else 9, 3))
    points[:, 2] *= kind != "plane"
    pose = Pose.from_rotvec(rng.normal(size=3), [*rng.uniform(-30, 30, 2), 300])
    px = camera.project(pose.apply(points))
    found = camera_poses(camera, points, px)
    # Of several solutions one is the truth; a plane seen head-on has both close together.
    assert min(np.linalg.norm(p.apply(points) - pose.apply(points)) for p in found) < 0.05
    best = resect({"a": camera}, {"a": Pose.identity()}, [[Observation("a", "v", points, px)]])
    assert best is not None
    assert np.linalg.norm(camera.project(best[0].apply(points)) - px, axis=1).max() < 0.5


def off_by(pose: Pose, rng: np.random.Generator, sd_rad: float, sd_mm: float) -> Pose:
    """A board's pose as measured: turned about its middle and shifted."""
    middle = pose.apply(CHESSBOARD.corners_mm.mean(0))
    turn = Pose.from_rotvec(rng.normal(0, sd_rad, 3), np.zeros(3)).rotation
    return Pose(turn, middle - turn @ middle + rng.normal(0, sd_mm, 3)) @ pose


def test_inexact_board_poses_place_the_frame_without_bending_the_lenses() -> None:
    names = list(SHOWN.poses)[:3]
    pictures = SHOWN.pictures(names)
    rig, past = calibrated()
    points = np.concatenate([p.apply(CHESSBOARD.corners_mm[::13]) for p in SHOWN.poses.values()])
    ratios = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        stated = {v: off_by(SHOWN.poses[v], rng, 4e-3, 0.3) for v in names}
        made = register_views(rig, past, pictures, stated, CHESSBOARD)
        assert not made.exact
        assert any("not as exact" in w for w in made.warnings)
        assert 0.1 < max(made.deviation_mm.values()) < 2.0
        for name in TRUE.names:
            # Two deviations of the lens; taken as exact, poses off by 0.3 mm (0.6 px) would move it by several.
            assert np.abs(made.rig.cameras[name].matrix - rig.cameras[name].matrix).max() < 0.4
        assert made.adjusted is not None
        px = {c: TRUE.project(c, points) for c in TRUE.names}
        found = made.rig.triangulate({c: made.rig.cameras[c].unproject(p) for c, p in px.items()})
        error = np.median(np.linalg.norm(found - points, axis=1))
        ratios.append(error / assess(made.rig, made.adjusted).point_sd_mm)
    # The predicted deviation comes from how three poses contradict each other, 12 numbers more than the frame takes:
    # good to a fifth. The error has six numbers: the ratio is within a factor of two and a half in all but rare cases.
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 2.5


def test_a_camera_that_moved_since_the_calibration_is_noticed() -> None:
    names = list(SHOWN.poses)[:2]
    rig, past = calibrated()
    nudge = Pose.from_rotvec([0.004, -0.003, 0.002], [0.3, 0, 0.2])
    moved = Stage(
        Rig(TRUE.cameras, {**TRUE.camera_from_base, "right": nudge @ TRUE.camera_from_base["right"]}),
        SHOWN.eyes,
        SHOWN.board,
        SHOWN.poses,
    )
    made = register_views(rig, past, moved.pictures(names), {v: SHOWN.poses[v] for v in names}, CHESSBOARD)
    assert any("moved since" in w for w in made.warnings)


def test_board_poses_that_contradict_each_other_are_refused() -> None:
    names = list(SHOWN.poses)[:2]
    stated = {
        names[0]: SHOWN.poses[names[0]],
        names[1]: Pose.from_rotvec([0, 0, 0.5], [60, 0, 0]) @ SHOWN.poses[names[1]],
    }
    with pytest.raises(InputError, match="contradict"):
        register_views(calibrated()[0], None, SHOWN.pictures(names), stated, CHESSBOARD)
