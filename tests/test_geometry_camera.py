"""Cameras and lenses: round trips, OpenCV's own projection, and the edge of what a lens can show.

Tolerances: the inversion of a lens stops at a residual of 1e-14 on the image plane; a focal length of 3000 px makes
that 3e-11 px, and where the picture is squeezed by five 1.5e-10 px. Coordinates of 1e3 px are rounded to 1e-13 px.
"""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geometry_scenes import cameras, few, seeds
from tubesight.geometry.camera import Camera
from tubesight.geometry.lens import LENSES, undistort

ROUND_TRIP_PX = 1e-9
OPENCV_PX = 1e-9


def field(seed: int, count: int = 40) -> np.ndarray:
    """Points in front of a camera, up to 0.7 off axis (35 degrees), 0.1 to 1 m away."""
    rng = np.random.default_rng(seed)
    radius, turn = 0.7 * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * np.pi, count)
    depth = rng.uniform(100, 1000, count)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.ones(count)], -1) * depth[:, None]


@few
@given(cameras(), seeds)
def test_pixels_return_from_their_rays(camera: Camera, seed: int) -> None:
    points = field(seed)
    px = camera.project(points)
    rays = camera.unproject(px)
    assert np.array_equal(rays[:, 2], np.ones(len(rays)))
    assert np.allclose(rays, points / points[:, 2:], rtol=0, atol=1e-12)
    assert np.allclose(camera.project(rays), px, rtol=0, atol=ROUND_TRIP_PX)
    # The image of a point does not know how far it is.
    assert np.allclose(camera.project(points * 7), px, rtol=0, atol=1e-11)


@few
@given(cameras("brown"), seeds)
def test_brown_lens_is_opencvs(camera: Camera, seed: int) -> None:
    compare_with_opencv(camera, seed)


@few
@given(cameras("rational"), seeds)
def test_rational_lens_is_opencvs(camera: Camera, seed: int) -> None:
    compare_with_opencv(camera, seed)


def compare_with_opencv(camera: Camera, seed: int) -> None:
    """OpenCV's model of the lens without skew, then the skew of equation 1."""
    points = field(seed)
    straight = np.array(camera.matrix)
    straight[0, 1] = 0
    px = cv2.projectPoints(points, np.zeros(3), np.zeros(3), straight, np.array(camera.distortion))[0].reshape(-1, 2)
    px[:, 0] += camera.matrix[0, 1] * (px[:, 1] - camera.matrix[1, 2]) / camera.matrix[1, 1]
    assert np.allclose(camera.project(points), px, rtol=0, atol=OPENCV_PX)


@few
@given(cameras("equidistant"), seeds)
def test_equidistant_lens_is_opencvs_fisheye(camera: Camera, seed: int) -> None:
    points = field(seed)[:, None]
    skew = float(camera.matrix[0, 1] / camera.matrix[0, 0])
    px = cv2.fisheye.projectPoints(
        points, np.zeros(3), np.zeros(3), np.array(camera.matrix), np.array(camera.distortion), alpha=skew
    )[0].reshape(-1, 2)
    assert np.allclose(camera.project(points[:, 0]), px, rtol=0, atol=OPENCV_PX)


@few
@given(cameras("brown"), seeds)
def test_ideal_lens_is_equation_1(camera: Camera, seed: int) -> None:
    ideal = Camera(camera.matrix, camera.size_px)
    px = ideal.project(field(seed))
    (fx, skew, cx), (_, fy, cy), _ = camera.matrix
    y = (px[:, 1] - cy) / fy
    x = ((px[:, 0] - cx) - (px[:, 1] - cy) * skew / fy) / fx
    assert np.allclose(ideal.unproject(px), np.stack([x, y, np.ones_like(x)], -1), rtol=0, atol=1e-15 * 10)


@few
@given(cameras(), seeds)
def test_derivatives_of_lenses_follow_differences(camera: Camera, seed: int) -> None:
    model, k = LENSES[camera.lens], camera.distortion
    xy = field(seed)[:, :2] / field(seed)[:, 2:]
    step = 1e-5
    columns = [
        (model.distort(xy + d, k) - model.distort(xy - d, k)) / (2 * step)
        for d in (np.array([step, 0]), np.array([0, step]))
    ]
    # Central differences: third derivatives of order ten times step^2 / 6, and rounding 1e-16 / step.
    assert np.allclose(model.jacobian(xy, k), np.stack(columns, -1), rtol=0, atol=1e-8)


@pytest.mark.parametrize("radius", [0.0, 1e-9, 0.99e-5, 1.01e-5, 1e-4])
def test_equidistant_lens_is_smooth_on_its_axis(radius: float) -> None:
    """The series takes over at r = 1e-5; both sides of the seam agree to its next term, r^4 = 1e-20, and rounding."""
    model, k = LENSES["equidistant"], np.array([0.1, -0.02, 0.003, 0.001])
    xy, angle = np.array([[radius, 0.0]]), np.arctan(radius)
    assert model.distort(xy, k)[0, 0] == pytest.approx(angle * (1 + k[0] * angle**2), rel=1e-14, abs=0)
    assert undistort(model, model.distort(xy, k), k)[0, 0] == pytest.approx(radius, rel=1e-9, abs=1e-14)
    # The next term of the derivative is 3 (k1 - 1 / 3) r^2.
    assert np.allclose(model.jacobian(xy, k), np.eye(2), rtol=0, atol=3 * radius**2 + 1e-12)


def test_a_point_behind_the_camera_has_no_image() -> None:
    camera = Camera(np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]]), (1000, 800))
    px = camera.project(np.array([[1.0, 2, 10], [1, 2, 0], [0, 0, 0], [1, 2, -10], [np.nan, 0, 1]]))
    assert np.isfinite(px).all(1).tolist() == [True, False, False, False, False]
    assert np.isnan(camera.unproject([np.nan, 3.0])[:2]).all()
    assert camera.project(np.ones((4, 5, 3))).shape == (4, 5, 2)
    assert camera.unproject(np.ones((4, 5, 2))).shape == (4, 5, 3)


@pytest.mark.parametrize(
    ("lens", "coefficients", "edge"),
    [
        # Distorted radius at which the lens folds over: r + k1 r^3 has its maximum 2 / 3 r at r = 1 / sqrt(-3 k1).
        ("brown", [-0.5, 0, 0, 0, 0], 2 / 3 / np.sqrt(1.5)),
        ("rational", [-0.5, 0, 0, 0, 0, 0, 0, 0], 2 / 3 / np.sqrt(1.5)),
        # The plane z = 1 ends at 90 degrees.
        ("equidistant", [0, 0, 0, 0], np.pi / 2),
    ],
)
def test_beyond_the_edge_of_a_lens_there_is_no_ray(lens: str, coefficients: list[float], edge: float) -> None:
    k = np.array(coefficients, float)
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rim = np.stack([np.cos(turn), np.sin(turn)], -1) * edge
    inside, outside = undistort(LENSES[lens], rim * 0.98, k), undistort(LENSES[lens], rim * 1.02, k)
    assert np.allclose(LENSES[lens].distort(inside, k), rim * 0.98, rtol=0, atol=1e-12)
    assert np.isnan(outside).all()
    # One hopeless point does not spoil its neighbours.
    both = undistort(LENSES[lens], np.stack([rim * 0.5, rim * 1e3]), k)
    assert np.isfinite(both[0]).all() and np.isnan(both[1]).all()


@few
@given(st.floats(-0.6, 0.6), st.floats(-0.3, 0.3), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), seeds)
def test_strong_lenses_return_the_near_branch(k1: float, k2: float, p1: float, p2: float, seed: int) -> None:
    """Everything up to the fold comes back, from far outside what `cameras` draws."""
    model, k = LENSES["brown"], np.array([k1, k2, p1, p2, 0.0])
    xy = field(seed)[:, :2] / field(seed)[:, 2:]
    way = np.linspace(0, 1, 100)[:, None, None] * xy
    jacobian = model.jacobian(way, k)
    regular = ((np.linalg.det(jacobian) > 0.05) & (np.trace(jacobian, axis1=-2, axis2=-1) > 0)).all(0)
    found = undistort(model, model.distort(xy[regular], k), k)
    # Residual 1e-14, amplified by the inverse of a derivative with determinant 0.05 and norm below 4: 80 times.
    assert np.allclose(found, xy[regular], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("radius", "k"), [(1.16, (0.33, -0.11, -0.05)), (1.29, (0.46, 0.01, -0.03)), (0.94, (0.47, -0.27, -0.06))]
)
def test_wild_lenses_need_shorter_steps(radius: float, k: tuple[float, float, float]) -> None:
    """Full Newton steps from the distorted point leave the region in which these lenses are regular."""
    model, coefficients = LENSES["brown"], np.array([k[0], k[1], 0, 0, k[2]])
    xy = np.array([[radius, 0.0]])
    assert np.allclose(undistort(model, model.distort(xy, coefficients), coefficients), xy, rtol=0, atol=1e-12)


def test_pixels_inside_the_picture() -> None:
    camera = Camera(np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]]), (1000, 800))
    px = np.array([[0.0, 0], [999, 799], [999.5, 10], [-0.1, 5], [np.nan, 5]])
    assert camera.contains(px).tolist() == [True, True, False, False, False]
    assert camera.contains(px, 1.0).tolist() == [False] * 5


def test_focal_length_is_the_mean_of_both() -> None:
    assert Camera(np.diag([400.0, 900, 1]), (10, 10)).focal_px == pytest.approx(600)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lens": "fancy"}, "expected one of brown, rational, equidistant, got 'fancy'"),
        ({"distortion": np.zeros(4)}, r"brown lens: expected shape \(5\), got \(4,\)"),
        ({"distortion": np.full(5, np.nan)}, "not finite"),
        ({"matrix": np.diag([-1.0, 1, 1])}, "have to be positive"),
        ({"matrix": np.array([[1.0, 0, 0], [0.1, 1, 0], [0, 0, 1]])}, "expected rows"),
        ({"size_px": (0, 10)}, "positive width and height"),
    ],
)
def test_what_is_not_a_camera_is_refused(change: dict[str, object], message: str) -> None:
    good = {"matrix": np.eye(3), "size_px": (10, 10), "distortion": np.zeros(5), "lens": "brown"}
    with pytest.raises(ValueError, match=message):
        Camera(**{**good, **change})  # type: ignore[arg-type]
