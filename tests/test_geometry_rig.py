"""Cameras in a common frame: epipolar geometry, triangulation, single parameters moved.

Tolerances: rays hold 1e-16, cameras stand 0.3 to 0.5 m away and at least 10 degrees apart, so that a triangulated point
is off by 500 mm * 1e-16 / sin(10 deg) / a few = 1e-12 mm.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geometry_scenes import IDEAL, Array, few, looking, poses, rays_of, rigs, seeds
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig, RigCovariance

POINT_MM = 1e-10


def volume(seed: int, count: int = 20) -> Array:
    """Points where the tube may be."""
    return np.random.default_rng(seed).uniform([-90, -90, 0], [90, 90, 160], (count, 3))


@few
@given(rigs(), seeds)
def test_images_of_one_point_satisfy_the_essential_matrix(rig: Rig, seed: int) -> None:
    points = volume(seed)
    a, b = (rays_of(rig, name, points) for name in rig.names)
    for matrix, left, right in ((rig.essential("left", "right"), a, b), (rig.essential("right", "left"), b, a)):
        size = np.linalg.norm(left, axis=1) * np.linalg.norm(right, axis=1) * np.linalg.norm(matrix)
        assert np.abs(np.einsum("ni,ij,nj->n", left, matrix, right) / size).max() < 1e-15 * 10
        # Essential: two equal singular values, the length of the baseline, and a zero.
        baseline = np.linalg.norm(rig.centre_mm("left") - rig.centre_mm("right"))
        assert np.allclose(np.linalg.svd(matrix, compute_uv=False), [baseline, baseline, 0], rtol=0, atol=1e-10)
    # A wrong pairing is seen: neighbours' images do not lie on each other's epipolar lines.
    wrong = np.einsum("ni,ij,nj->n", a, rig.essential("left", "right"), np.roll(b, 1, 0))
    assert np.abs(wrong).max() > 1e-3


@few
@given(rigs(), seeds)
def test_relative_poses_carry_points_between_cameras(rig: Rig, seed: int) -> None:
    points = volume(seed)
    moved = rig.relative_pose("left", "right").apply(rig.camera_from_base["right"].apply(points))
    assert np.allclose(moved, rig.camera_from_base["left"].apply(points), rtol=0, atol=POINT_MM)
    for name in rig.names:
        assert np.allclose(rig.camera_from_base[name].apply(rig.centre_mm(name)), 0, rtol=0, atol=POINT_MM)
        off = np.cross(points - rig.centre_mm(name), rig.directions(name, rays_of(rig, name, points)))
        assert np.abs(off).max() < POINT_MM
        assert np.allclose(rig.project(name, points), IDEAL.project(rays_of(rig, name, points)), rtol=0, atol=1e-10)


@few
@given(rigs(), seeds)
def test_triangulation_returns_exact_points(rig: Rig, seed: int) -> None:
    points = volume(seed)
    rays = {name: rays_of(rig, name, points) for name in rig.names}
    assert np.allclose(rig.triangulate(rays), points, rtol=0, atol=POINT_MM)


@few
@given(rigs(), poses, st.floats(0.01, 100), seeds)
def test_triangulation_turns_moves_and_scales_with_the_rig(rig: Rig, move: Pose, scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = volume(seed)
    rays = {n: rays_of(rig, n, points) + np.append(rng.normal(0, 1e-3, 2), 0) for n in rig.names}
    found = rig.triangulate(rays)
    swapped = Rig(rig.cameras, {n: rig.camera_from_base[n] for n in reversed(rig.names)})
    assert np.allclose(swapped.triangulate(dict(reversed(rays.items()))), found, rtol=0, atol=1e-9)
    moved = Rig(rig.cameras, {n: p @ move.inverse() for n, p in rig.camera_from_base.items()})
    # Noisy rays: Gauss-Newton's three steps leave less than 1e-9 of the first step's millimetre.
    assert np.allclose(moved.triangulate(rays), move.apply(found), rtol=0, atol=1e-8)
    larger = Rig(rig.cameras, {n: Pose(p.rotation, p.translation_mm * scale) for n, p in rig.camera_from_base.items()})
    assert np.allclose(larger.triangulate(rays), found * scale, rtol=1e-9, atol=1e-9 * scale)


@few
@given(rigs(), seeds)
def test_triangulation_minimises_the_reprojection_error(rig: Rig, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = volume(seed, 5)
    rays = {n: rays_of(rig, n, points) + np.column_stack([rng.normal(0, 1e-3, (5, 2)), np.zeros(5)]) for n in rig.names}
    found = rig.triangulate(rays)

    def squares(at: Array) -> Array:
        return np.asarray(sum(((rays_of(rig, n, at) - rays[n]) ** 2).sum(1) for n in rig.names))

    best = squares(found)
    for step in 0.01 * np.vstack([np.eye(3), -np.eye(3)]):
        assert (squares(found + step) > best).all()


def test_triangulation_uses_every_camera_that_sees_the_point() -> None:
    centres = {n: 400 * np.array([np.cos(a), np.sin(a), 0.2]) for n, a in (("a", 0), ("b", 1), ("c", 2))}
    rig = Rig(dict.fromkeys(centres, IDEAL), {n: looking(c, np.zeros(3), 0.0) for n, c in centres.items()})
    points = volume(1, 4)
    rays = {n: rays_of(rig, n, points) for n in rig.names}
    rays["a"][0] = rays["b"][1] = rays["a"][2] = rays["c"][2] = np.nan
    for n in rig.names:
        rays[n][3] = np.nan
    found = rig.triangulate(rays)
    assert np.allclose(found[:2], points[:2], rtol=0, atol=POINT_MM)
    assert np.isnan(found[2:]).all()


def test_parallel_rays_meet_nowhere() -> None:
    aside = Pose(np.eye(3), np.array([-100.0, 0, 0]))
    rig = Rig({"left": IDEAL, "right": IDEAL}, {"left": Pose.identity(), "right": aside})
    ray = np.array([[0.1, 0.2, 1.0]])
    assert np.isnan(rig.triangulate({"left": ray, "right": ray})).all()
    both = {"left": np.vstack([ray, ray]), "right": np.vstack([ray, ray - [[0.05, 0, 0]]])}
    found = rig.triangulate(both)
    assert np.isnan(found[0]).all()
    assert np.allclose(found[1], ray[0] * 2000, rtol=1e-12)


def test_rays_that_meet_behind_the_cameras_have_no_point() -> None:
    aside = Pose(np.eye(3), np.array([-100.0, 0, 0]))
    rig = Rig({"left": IDEAL, "right": IDEAL}, {"left": Pose.identity(), "right": aside})
    # 100 mm apart and diverging: the lines meet at z = -250.
    found = rig.triangulate({"left": np.array([[-0.2, 0, 1.0]]), "right": np.array([[0.2, 0, 1.0]])})
    assert np.isnan(found).all()


@few
@given(rigs(), seeds)
def test_rays_that_do_not_meet_give_a_number_or_nan(rig: Rig, seed: int) -> None:
    """Unrelated rays, also those that meet behind a camera, give no exception and no warning."""
    rng = np.random.default_rng(seed)
    rays = {n: np.column_stack([rng.normal(0, 1, (30, 2)), np.ones(30)]) for n in rig.names}
    found = rig.triangulate(rays)
    assert found.shape == (30, 3)
    assert (np.isfinite(found).all(1) | np.isnan(found).all(1)).all()


@pytest.mark.parametrize(
    "parameter", ["f", "fx", "fy", "cx", "cy", "skew", "k1", "p2", "rx", "ry", "rz", "tx", "ty", "tz"]
)
def test_a_moved_parameter_moves_what_its_name_says(parameter: str) -> None:
    camera = Camera(np.array([[1500.0, 2, 960], [0, 1200, 540], [0, 0, 1]]), (1920, 1080), np.array([0.1, 0, 0, 0, 0]))
    pose = looking(np.array([400.0, 10, 90]), np.array([0.0, 0, 80]), 0.3)
    rig = Rig({"left": camera, "right": camera}, {"left": pose, "right": pose})
    step = 1e-3
    moved = rig.perturbed(f"left.{parameter}", step)
    assert np.array_equal(moved.cameras["right"].matrix, camera.matrix)
    change = moved.cameras["left"].matrix - camera.matrix
    expected = np.zeros((3, 3))
    for key, place in (("fx", (0, 0)), ("fy", (1, 1)), ("cx", (0, 2)), ("cy", (1, 2)), ("skew", (0, 1))):
        expected[place] = step * (parameter == key)
    if parameter == "f":
        expected[0, 0], expected[1, 1] = step, step * 1200 / 1500
    assert np.allclose(change, expected, rtol=0, atol=1e-12)
    bent = moved.cameras["left"].distortion - camera.distortion
    assert np.allclose(bent, [step * (parameter == k) for k in ("k1", "k2", "p1", "p2", "k3")], rtol=0, atol=1e-15)
    now = moved.camera_from_base["left"]
    turn = Pose(now.rotation @ pose.rotation.T, np.zeros(3)).rotvec_rad
    assert np.allclose(turn, [step * (parameter == k) for k in ("rx", "ry", "rz")], rtol=0, atol=1e-14)
    shift = now.translation_mm - pose.translation_mm
    assert np.allclose(shift, [step * (parameter == k) for k in ("tx", "ty", "tz")], rtol=0, atol=1e-12)


def test_unknown_names_are_refused() -> None:
    rig = Rig({"left": IDEAL}, {"left": Pose.identity()})
    with pytest.raises(ValueError, match=r"no parameter 'left\.k9'"):
        rig.perturbed("left.k9", 1.0)
    with pytest.raises(ValueError, match="does not have: right"):
        Rig({"left": IDEAL}, {"right": Pose.identity()})
    with pytest.raises(ValueError, match="at least one camera"):
        Rig({}, {})
    with pytest.raises(ValueError, match=r"expected shape \(2, 2\), got \(3, 3\)"):
        RigCovariance(("left.cx", "left.cy"), np.eye(3))
    assert rig.registered and not Rig(rig.cameras, rig.camera_from_base, "left").registered
