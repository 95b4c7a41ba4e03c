"""Rigid transforms: a group, and the registration of point sets.

Tolerances: a rotation holds each coordinate to a few units in the last place, so a point of 1 m passed through a
handful of transforms is off by some 1e-16 * 1000 mm * 10 = 1e-12 mm.
"""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geometry_scenes import few, poses, seeds, triples
from tubesight.geometry.pose import Pose, register_rigid

ROUNDING_MM = 1e-11


def same(a: Pose, b: Pose) -> bool:
    return bool(
        np.allclose(a.rotation, b.rotation, rtol=0, atol=1e-14)
        and np.allclose(a.translation_mm, b.translation_mm, rtol=0, atol=ROUNDING_MM)
    )


@few
@given(poses, poses, poses)
def test_poses_form_a_group(a: Pose, b: Pose, c: Pose) -> None:
    assert same((a @ b) @ c, a @ (b @ c))
    assert same(a @ Pose.identity(), a)
    assert same(Pose.identity() @ a, a)
    assert same(a @ a.inverse(), Pose.identity())
    assert same(a.inverse() @ a, Pose.identity())
    assert same((a @ b).inverse(), b.inverse() @ a.inverse())


@few
@given(poses, poses, triples(500.0))
def test_composition_applies_the_right_one_first(a: Pose, b: Pose, point: np.ndarray) -> None:
    assert np.allclose((a @ b).apply(point), a.apply(b.apply(point)), rtol=0, atol=ROUNDING_MM)
    assert np.allclose(a.apply(point) - a.apply(np.zeros(3)), a.rotate(point), rtol=0, atol=ROUNDING_MM)
    assert np.allclose((a.matrix @ np.append(point, 1))[:3], a.apply(point), rtol=0, atol=ROUNDING_MM)


@few
@given(poses)
def test_representations_agree(a: Pose) -> None:
    assert same(Pose.from_matrix(a.matrix), a)
    assert same(Pose.from_rotvec(a.rotvec_rad, a.translation_mm), a)
    assert np.allclose(a.rotation @ a.rotation.T, np.eye(3), rtol=0, atol=1e-15 * 10)
    assert np.linalg.det(a.rotation) == pytest.approx(1, abs=1e-14)


def test_application_keeps_the_shape_of_its_argument() -> None:
    pose = Pose.from_rotvec([0.1, 0.2, 0.3], [1.0, 2, 3])
    assert pose.apply(np.zeros(3)).shape == (3,)
    assert pose.apply(np.zeros((2, 5, 3))).shape == (2, 5, 3)


@few
@given(poses, st.integers(0, 8))
def test_a_rotation_rounded_in_a_file_is_projected_onto_one(a: Pose, entry: int) -> None:
    rounded = np.round(a.rotation, 6)
    mended = Pose(rounded, a.translation_mm).rotation
    assert np.allclose(mended @ mended.T, np.eye(3), rtol=0, atol=1e-14)
    # The nearest rotation to a matrix that is e away from a rotation is at most 2 e away from that one.
    assert np.linalg.norm(mended - a.rotation) <= 2 * np.linalg.norm(rounded - a.rotation) + 1e-15
    wrong = np.array(a.rotation)
    wrong.flat[entry] += 1e-3
    with pytest.raises(ValueError, match="not orthonormal"):
        Pose(wrong, a.translation_mm)


@pytest.mark.parametrize(
    ("rotation", "translation", "message"),
    [
        (np.diag([1.0, 1, -1]), np.zeros(3), "mirrored"),
        (2 * np.eye(3), np.zeros(3), "not orthonormal"),
        (np.eye(3) * np.nan, np.zeros(3), "not finite"),
        (np.eye(3), np.array([0, 0, np.inf]), "not finite"),
        (np.eye(2), np.zeros(3), r"expected shape \(3, 3\), got \(2, 2\)"),
    ],
)
def test_what_is_not_a_pose_is_refused(rotation: np.ndarray, translation: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Pose(rotation, translation)
    bad = np.eye(4)
    bad[3, 0] = 1
    with pytest.raises(ValueError, match="last row"):
        Pose.from_matrix(bad)


def test_poses_cannot_be_changed() -> None:
    pose = Pose.identity()
    with pytest.raises(ValueError, match="read-only"):
        pose.translation_mm[0] = 1


@few
@given(poses, seeds, st.integers(3, 20))
def test_registration_of_exact_points(pose: Pose, seed: int, count: int) -> None:
    b = np.random.default_rng(seed).normal(0, 50, (count, 3))
    spread = np.linalg.svd(b - b.mean(0), compute_uv=False)
    assume(spread[1] > 0.05 * spread[0])
    found = register_rigid(pose.apply(b), b)
    # The cross-covariance squares the spreads: rounding turns the points by eps (spread0 / spread1)^2 = 1e-13 rad.
    assert np.allclose(found.apply(b), pose.apply(b), rtol=0, atol=1e-10)


@few
@given(poses, seeds)
def test_registration_of_a_plane_is_a_rotation(pose: Pose, seed: int) -> None:
    b = np.random.default_rng(seed).normal(0, 50, (8, 3)) * [1, 1, 0]
    found = register_rigid(pose.apply(b), b)
    assert np.allclose(found.apply(b), pose.apply(b), rtol=0, atol=1e-10)


@few
@given(poses, poses, seeds)
def test_registration_is_least_squares_and_turns_with_its_points(a: Pose, other: Pose, seed: int) -> None:
    rng = np.random.default_rng(seed)
    b = rng.normal(0, 50, (12, 3))
    noisy = a.apply(b) + rng.normal(0, 0.5, b.shape)
    found = register_rigid(noisy, b)
    best = ((found.apply(b) - noisy) ** 2).sum()
    for step in np.vstack([np.eye(6), -np.eye(6)]) * 1e-4:
        moved = Pose.from_rotvec(step[:3], step[3:]) @ found
        assert ((moved.apply(b) - noisy) ** 2).sum() > best
    assert same(register_rigid(other.apply(noisy), b), other @ found)
    assert same(register_rigid(b, noisy), found.inverse())


def test_registration_of_a_mirrored_set_stays_a_rotation() -> None:
    b = np.random.default_rng(0).normal(0, 50, (10, 3))
    found = register_rigid(b * [1, 1, -1], b)
    assert np.linalg.det(found.rotation) == pytest.approx(1, abs=1e-14)


@few
@given(poses, triples(50.0), triples(1.0))
def test_registration_refuses_points_on_a_line(pose: Pose, start: np.ndarray, direction: np.ndarray) -> None:
    assume(np.linalg.norm(direction) > 1e-3)
    b = start + np.arange(5)[:, None] * direction
    with pytest.raises(ValueError, match="on a line"):
        register_rigid(pose.apply(b), b)


def test_registration_refuses_what_it_cannot_pair() -> None:
    points = np.random.default_rng(0).normal(size=(4, 3))
    with pytest.raises(ValueError, match="at least 3 pairs, got 2 and 2"):
        register_rigid(points[:2], points[:2])
    with pytest.raises(ValueError, match="got 4 and 3"):
        register_rigid(points, points[:3])
    hole = points.copy()
    hole[1, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        register_rigid(points, hole)


def test_rotation_vectors_follow_scipy() -> None:
    vector = np.array([0.3, -0.4, 1.2])
    assert np.allclose(
        Pose.from_rotvec(vector, np.zeros(3)).rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-15
    )
