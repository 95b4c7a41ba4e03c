"""Shape, agreement and points of curves: compiled code against NumPy twins, deviations against displaced curves."""

import math

import numpy as np
import pytest

from fit_scenes import curve, views_of
from tubesight.core import Tip, Tube
from tubesight.core.kernels import COMPILED
from tubesight.geometry import deviations, point_kernels, shape, shape_kernels
from tubesight.geometry.camera import Camera
from tubesight.geometry.curve import Arc, NodeCurve, arc, hermite
from tubesight.geometry.deviations import Deviations
from tubesight.geometry.families import BASE, FAMILIES
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods import agreement, agreement_kernels
from tubesight.methods.rays import lens, optics
from tubesight.simulate import rig_around

compiled = pytest.mark.skipif(not COMPILED, reason="nothing is compiled here")

RIG = rig_around(80.0, size_px=(1280, 720))
BALL = Tube(12.0, Tip("ball", 16.0), clamped=True)
# Twins do the same sums in another order: a few thousand roundings of 1e-16 on numbers up to 1e3.
CLOSE = {"rtol": 1e-9, "atol": 1e-9}
CURVES = {
    "straight": ("circle", [0.0, 0.0, 150.0]),
    "nearly straight": ("circle", [1e-7, 2e-7, 150.0]),
    "circle": ("circle", [0.5, 0.3, 150.0]),
    "ellipse": ("ellipse", [0.5, 0.3, 0.2, -0.4, 150.0]),
    "two arcs": ("arcs2", [0.6, 0.2, -0.5, 0.1, 0.2, 150.0]),
}


def covariance_of(family: str, size: float = 1.0) -> np.ndarray:
    """Deviations of a few milliradians and hundredths of a millimetre that hang together."""
    rng = np.random.default_rng(3)
    count = FAMILIES[family].count
    scale = size * np.array([2e-3] * (count - 1) + [0.03, 0.02, 0.02, 5e-4, 5e-4])
    mixed = np.eye(count + BASE) + 0.3 * rng.normal(size=(count + BASE, count + BASE))
    return np.asarray(mixed @ mixed.T * scale * scale[:, None])


@compiled
@pytest.mark.parametrize("name", CURVES)
def test_numbers_and_derivatives_agree(name: str) -> None:
    family, parameters = CURVES[name]
    nodes = curve(family, parameters)
    want, want_rows = shape.measured(*nodes.arrays)
    got, rows = shape_kernels.measured(*nodes.arrays)
    np.testing.assert_allclose(got, want, **CLOSE)
    if name == "straight":  # the tip is on the axis to rounding: no azimuth
        rows[4] = want_rows[4]
    # The axes of turns of 1e-9 rad are known to 1e-7.
    loose = {"rtol": 1e-5, "atol": 1e-5} if name == "nearly straight" else CLOSE
    np.testing.assert_allclose(rows, want_rows, **loose)
    covariance = covariance_of(family)
    np.testing.assert_allclose(shape_kernels.spread(rows, covariance), shape.spread(rows, covariance), **CLOSE)


@pytest.mark.parametrize("name", ["circle", "ellipse", "two arcs"])
def test_deviations_are_those_of_displaced_curves(name: str) -> None:
    """Where nothing bends by as little as its deviation; 1 % of the derivatives, and 1 % of curvature near a kink."""
    family, parameters = CURVES[name]
    nodes, covariance = curve(family, parameters), covariance_of(family, 0.1)
    displaced = Deviations(family, nodes, lambda: covariance)
    points = (nodes.s_mm, nodes.points, nodes.tangents)
    got = shape.shape_of(NodeCurve(family, *points, displaced), 0.1)
    want = shape.shape_of(NodeCurve(family, *points, displaced.curves), 0.1)
    assert got.orientation_rad == want.orientation_rad
    for key in ("tip_x", "tip_y", "tip_z", "bending", "orientation", "length"):
        assert got.sd[key] == pytest.approx(want.sd[key], rel=0.01), key
    if name != "two arcs":  # the spline through displaced nodes swings at the kink
        assert got.sd["curvature"] == pytest.approx(want.sd["curvature"], rel=0.02)
    assert all(math.isnan(sd) for sd in got.sd_rig.values())


def test_a_straight_tube_may_bend_either_way() -> None:
    """Both ways of bending add, though neither has a derivative."""
    nodes = curve("circle", [0.0, 0.0, 150.0])
    covariance = np.zeros((7, 7))
    covariance[0, 0], covariance[1, 1] = 0.003**2, 0.004**2
    found = shape.shape_of(
        NodeCurve("circle", nodes.s_mm, nodes.points, nodes.tangents, Deviations("circle", nodes, lambda: covariance)),
        0.1,
    )
    assert found.sd["bending"] == pytest.approx(0.005, rel=1e-6)
    assert found.sd["curvature"] == pytest.approx(0.005 / 150.0, rel=1e-6)
    assert math.isnan(found.orientation_rad) and math.isnan(found.sd["orientation"])


@compiled
@pytest.mark.parametrize("size", [0.01, 1e4])
def test_bounds_agree(size: float) -> None:
    nodes, covariance = curve("circle", [0.5, 0.3, 150.0]), covariance_of("circle", size)
    want = deviations.bounded(nodes.s_mm, nodes.d_s, covariance)
    assert shape_kernels.bounded(nodes.s_mm, nodes.d_s, covariance) == want
    assert want == (size < 1)


@compiled
def test_points_agree() -> None:
    """Inside, at nodes, past both ends and out of order."""
    nodes = curve("ellipse", [0.5, 0.3, 0.2, -0.4, 150.0])
    at = np.concatenate([[155.0, -3.0], nodes.s_mm, [149.9, 0.1, 75.0]])
    given = (nodes.s_mm, nodes.points, nodes.tangents, at)
    for got, want in zip(point_kernels.hermite(*given), hermite(*given), strict=True):
        np.testing.assert_allclose(got, want, **CLOSE)
    start = Pose.from_rotvec([0.3, 0.2, -0.4], [5.0, 6.0, 7.0])
    for curvature in ([0.0, 0.0], [1e-12, 0.0], [0.01, -0.006]):
        given = (np.array(curvature), start.rotation, start.translation_mm, at)
        for got, want in zip(point_kernels.arc(*given), arc(*given), strict=True):
            np.testing.assert_allclose(got, want, **CLOSE)


@compiled
@pytest.mark.parametrize(
    "bent", [Arc(np.array([0.004, 0.002]), 150.0), Arc(np.array([0.045, 0.02]), 150.0), Arc(np.zeros(2), 60.0)]
)
@pytest.mark.parametrize(
    ("name", "k"),
    [("brown", [-0.2, 0.05, 1e-3, -2e-3, 0.01]), ("rational", [0.3, 0.1, 1e-3, -2e-3, 0.01, 0.5, 0.05, 0])],
)
def test_distances_from_a_curve_agree(bent: Arc, name: str, k: list[float]) -> None:
    """Also of a curve that winds once around, one that is too short, and one of a single point."""
    view = views_of(curve("circle", [0.5, 0.3, 150.0]), RIG, BALL, 0.3)["left"]
    pose = RIG.camera_from_base["left"]
    camera = Camera(RIG.cameras["left"].matrix, (1280, 720), np.array(k), name)
    known = lens(camera)
    assert known is not None
    for points in (
        bent.at(np.linspace(0, bent.length_mm, 100)),
        np.tile(bent.at([5.0]), (100, 1)),
        bent.at([0.0, 9.0]),
    ):
        want = agreement.off_squares(points, pose, camera, view)
        got = agreement_kernels.off_squares(
            points, pose.rotation, pose.translation_mm, *known, view.centreline_px, view.tip.px
        )
        assert got == pytest.approx(want, rel=1e-9)
    behind = points - 1e4 * pose.rotation[2]
    assert agreement.off_squares(behind, pose, camera, view) == math.inf
    given = (pose.rotation, pose.translation_mm, *known, view.centreline_px, view.tip.px)
    assert agreement_kernels.off_squares(behind, *given) == math.inf


@compiled
@pytest.mark.parametrize("off", [0.0, 1e-3, 0.05])
def test_triangulation_agrees(off: float) -> None:
    """Also of rays that miss each other by some pixels and by fifty."""
    sight = optics(RIG, RIG.names)
    for point in ([0.0, 0.0, 150.0], [40.0, -30.0, 90.0]):
        rays = {n: RIG.camera_from_base[n].apply(np.array(point)) for n in RIG.names}
        rays = {n: v / v[2] + [0.0, off if n == "left" else 0.0, 0.0] for n, v in rays.items()}
        want = RIG.triangulate({n: v[None] for n, v in rays.items()})[0]
        given = (np.stack(list(rays.values())), sight.rotation, sight.translation_mm, sight.focal_px)
        np.testing.assert_allclose(agreement_kernels.triangulated(*given), want, **CLOSE)


@compiled
def test_rays_that_do_not_meet_give_no_point() -> None:
    beside = Rig(RIG.cameras, {n: Pose(np.eye(3), np.array([x, 0.0, 0.0])) for n, x in (("left", 0.0), ("right", 9.0))})
    ahead = {n: np.array([0.1, 0.1, 1.0]) for n in RIG.names}
    assert np.isnan(agreement.triangulated(ahead, beside)).all()
    apart = {"left": np.array([0.1, 0.0, 1.0]), "right": np.array([-0.1, 0.0, 1.0])}
    assert np.isnan(agreement.triangulated(apart, beside)).all()  # they meet behind the cameras
    assert np.isnan(agreement.triangulated({"left": ahead["left"]}, beside)).all()
