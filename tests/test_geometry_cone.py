"""Cone and rays: every root, tangent rays, degenerate cones.

What float64 can know of a root. The conic and the rays carry a relative error ``eta`` of a few units in the last place.
Seen from the cone camera the point of a ray at depth r moves along the epipolar line; a relative change ``rho`` of r
moves it off the conic by ``sweep * rho`` to first order (`Sight.sweep`: the disparity rate times the sine of the
crossing angle) and by ``curvature * (rate * rho)^2 / 2`` to second. Setting the sum to ``eta`` gives

    rho <= eta / sweep                     where the ray crosses the conic,
    rho <= sqrt(2 eta / curvature) / rate  where it only touches it.

The largest eta of 6000 draws was 2e-15, and 3.2e-12 where the conic counts as a line: it is then straightened by up to
1e-11 of its length, and every ray crosses it alike, at a sweep of 0.01 and more. So 1e-9 holds for every ray with
sweep >= 1e-5, one that crosses at more than 0.0006 to 0.003 degrees. With rates of 0.17 (cameras 10 degrees apart) and
curvatures of 1 and more the others keep 1e-6. None is lost.
"""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from geometry_scenes import LENGTH_MM, Array, Sight, few, looking, poses, rigs, seeds, sight, tubes
from tubesight.geometry.cone import Cone, Hits, epipolar_crossing
from tubesight.geometry.conic import Conic, fit_line, fit_taubin
from tubesight.geometry.polyline import place_along
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate import Arc, EllipseArc, rig_around

CROSSES = 1e-5
CROSSING_RAYS, TOUCHING_RAYS = 1e-9, 1e-6
# Rays of the cone view's curve crossed at less than 3 degrees by 90 % of the other's rays: the two cameras and the tube
# lie in one plane, or nearly, and no method could tell its depth.
USABLE_CROSSING = 0.05
ELLIPTIC = st.builds(
    EllipseArc, st.floats(np.radians(5), np.radians(90)), st.floats(0.5, 2), st.floats(0, 6.3), st.just(LENGTH_MM)
)


def relative_error(hits: Hits, depths_mm: Array) -> Array:
    """Distance (N,) of the nearer root, relative; infinite where there is none."""
    off = np.abs(hits.depths_mm / depths_mm[:, None] - 1)
    return np.asarray(np.where(np.isfinite(off), off, np.inf).min(1))


def check_roots(s: Sight) -> None:
    error = relative_error(Cone(fit_taubin(s.arc)).intersect(s.cone_from_ray, s.rays), s.depths_mm)
    assert error[s.sweep >= CROSSES].max(initial=0) < CROSSING_RAYS
    assert error.max() < TOUCHING_RAYS


@few
@given(rigs(), tubes)
def test_cone_and_rays_return_circular_tubes(rig: Rig, tube: Arc) -> None:
    s = sight(rig, tube)
    assume(s.crossing > USABLE_CROSSING)
    check_roots(s)


@few
@given(rigs(), ELLIPTIC)
def test_cone_and_rays_return_elliptic_tubes(rig: Rig, tube: EllipseArc) -> None:
    s = sight(rig, tube)
    assume(s.crossing > USABLE_CROSSING)
    check_roots(s)


@few
@given(rigs(), st.floats(-12, -1).map(lambda e: 10.0**e), st.sampled_from([0.0, np.pi / 2]))
def test_cone_and_rays_return_tubes_of_every_small_bend(rig: Rig, theta: float, phi: float) -> None:
    """Down to the straight one: the conic turns into a double line on the way."""
    s = sight(rig, Arc(theta, phi, LENGTH_MM))
    assume(s.crossing > USABLE_CROSSING)
    check_roots(s)


@pytest.mark.parametrize("exponent", range(-12, -1))
def test_a_camera_almost_in_the_plane_of_the_bend_makes_a_good_cone(exponent: int) -> None:
    """Its curve is 10^exponent deep: ``L2^2 - 4 L1 L3`` would lose half of all digits, ``-l^T adj(C) l`` loses none."""
    tube = Arc(np.pi / 2, 10.0**exponent, LENGTH_MM)
    s = sight(rig_around(90.0, distance_mm=400.0, distortion=(0.0,) * 5), tube)
    error = relative_error(Cone(fit_taubin(s.arc)).intersect(s.cone_from_ray, s.rays), s.depths_mm)
    # Straightened by 1e-11 of its length below that; sweeps are 0.7 and more.
    assert error.max() < (1e-11 if exponent <= -10 else 1e-13)


@few
@given(rigs(), tubes, st.floats(0.001, 1000))
def test_roots_scale_with_the_world(rig: Rig, tube: Arc, scale: float) -> None:
    s = sight(rig, tube)
    cone = Cone(fit_taubin(s.arc))
    larger = Pose(s.cone_from_ray.rotation, s.cone_from_ray.translation_mm * scale)
    here, there = cone.intersect(s.cone_from_ray, s.rays), cone.intersect(larger, s.rays)
    # Rounding of the scaled translation acts as eta does.
    ok = s.sweep >= CROSSES
    assert np.allclose(there.depths_mm[ok] / scale, here.depths_mm[ok], rtol=CROSSING_RAYS, atol=0, equal_nan=True)
    assert np.array_equal(there.valid[ok], here.valid[ok])


@few
@given(rigs(), tubes, seeds)
def test_both_roots_lie_on_the_cone(rig: Rig, tube: Arc, seed: int) -> None:
    """On noisy conics too: each root's image satisfies ``x^T C x = 0``."""
    s = sight(rig, tube)
    conic = fit_taubin(s.arc + np.random.default_rng(seed).normal(0, 1e-3, s.arc.shape))
    hits = Cone(conic).intersect(s.cone_from_ray, s.rays)
    points = s.cone_from_ray.apply(s.rays[:, None] * hits.depths_mm[..., None]) @ conic.frame.T
    value = np.einsum("nki,ij,nkj->nk", points, conic.normal, points)
    # What the three terms of the equation are made of; a root is known to a share of it.
    a = s.rays @ (conic.frame @ s.cone_from_ray.rotation).T
    b = conic.frame @ s.cone_from_ray.translation_mm
    size = (np.linalg.norm(a, axis=1)[:, None] * np.abs(hits.depths_mm) + np.linalg.norm(b)) ** 2
    found = np.isfinite(hits.depths_mm)
    assert np.abs(value[found]).max(initial=0) < 1e-13 * size[found].max(initial=1)
    assert (np.diff(hits.depths_mm, axis=1)[found.all(1)] >= 0).all()
    assert not hits.valid[~found].any()


@few
@given(rigs(), tubes)
def test_roots_are_those_of_equations_6_to_9(rig: Rig, tube: Arc) -> None:
    """The textbook formula on the image plane, where it is good enough to compare with."""
    s = sight(rig, tube, 11)
    conic = fit_taubin(s.arc)
    assume(conic.kind in ("ellipse", "hyperbola"))
    hits = Cone(conic).intersect(s.cone_from_ray, s.rays)
    rotation, t, c = s.cone_from_ray.rotation, s.cone_from_ray.translation_mm, conic.matrix
    rv = s.rays @ rotation.T
    l1, l2, l3 = np.einsum("ni,ij,nj->n", rv, c, rv), 2 * rv @ c @ t, t @ c @ t
    discriminant = l2**2 - 4 * l1 * l3
    # It cancels: use it where nine digits of sixteen are left.
    good = discriminant > 1e-4 * (l2**2 + np.abs(4 * l1 * l3))
    both = (-l2[good, None] + np.sqrt(discriminant[good, None]) * [-1, 1]) / (2 * l1[good, None])
    assert np.allclose(np.sort(both, 1), hits.depths_mm[good], rtol=1e-6)


def unit_cone() -> Cone:
    """Cone ``x^2 + y^2 = z^2``."""
    return Cone(Conic.from_matrix(np.diag([1.0, 1, -1])))


@few
@given(st.floats(0, 2 * np.pi), st.floats(50, 500), st.floats(50, 500), st.floats(-1, 1), st.floats(0.2, 1.4), poses)
def test_tangent_rays_count(turn: float, z: float, depth: float, along: float, across: float, ray: Pose) -> None:
    """A ray that touches the cone at a known point has that point as its double root."""
    point = z * np.array([np.cos(turn), np.sin(turn), 1.0])
    direction = along * point / np.linalg.norm(point) + across * np.array([-np.sin(turn), np.cos(turn), 0.0])
    v = ray.inverse().rotate(direction)
    assume(v[2] > 0.1)
    v = v / v[2]
    cone_from_ray = Pose(ray.rotation, point - depth * ray.rotate(v))
    hits = unit_cone().intersect(cone_from_ray, v[None])
    assert hits.tangent.all() and hits.valid.all()
    # The formula for touching rays, with the conic's curvature 1. eta = 1.7e-14 was the largest of 30000 draws: depths
    # of 500 mm carry ten times the rounding of points at 50 mm, and steep rays some times more.
    moved = ray.rotate(v)
    rate = np.linalg.norm(moved[:2] - point[:2] / z * moved[2]) / z * depth
    assert np.abs(hits.depths_mm / depth - 1).max() < np.sqrt(2 * 5e-14) / rate


def test_rays_beside_the_tangent_hit_twice_or_miss() -> None:
    """Rays at height z = 1 across the unit cone, x = 1 + offset: no root, a double root, two roots."""
    offset = np.array([1e-6, 1e-11, 0.0, -1e-11, -1e-6])
    cone_from_ray = Pose(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0, -10.0, 1]))
    found = []
    for x in 1 + offset:
        # The ray camera stands at y = -10 and looks along +y.
        hits = unit_cone().intersect(Pose(cone_from_ray.rotation, [x, -10.0, 1.0]), np.array([[0.0, 0, 1]]))
        found.append((np.isfinite(hits.depths_mm).sum(), bool(hits.tangent[0])))
    # A share of 1e-11 of the discriminant is beyond rounding: two roots or none.
    assert found == [(0, False), (0, False), (2, True), (2, False), (2, False)]
    hits = unit_cone().intersect(Pose(cone_from_ray.rotation, [1 - 1e-6, -10.0, 1.0]), np.array([[0.0, 0, 1]]))
    half = np.sqrt(1 - (1 - 1e-6) ** 2)
    assert np.allclose(hits.depths_mm, [[10 - half, 10 + half]], rtol=1e-12)


@few
@given(st.floats(0, 2 * np.pi), st.floats(20, 300), st.floats(20, 300))
def test_a_ray_parallel_to_a_line_of_the_cone_meets_it_once(turn: float, depth: float, z: float) -> None:
    """``L1 = 0``: one root is at infinity and NaN, the other is found."""
    line = np.array([np.cos(turn), np.sin(turn), 1.0])
    other = z * np.array([-np.cos(turn), -np.sin(turn), 1.0])
    hits = unit_cone().intersect(Pose(np.eye(3), other - depth * line), line[None])
    finite = hits.depths_mm[np.isfinite(hits.depths_mm) & (np.abs(hits.depths_mm) < 1e9)]
    # Rounding may put the other root at 1e16 times the size of the scene instead of at infinity.
    assert finite == pytest.approx([depth], rel=1e-12)


def test_an_exactly_parallel_ray_has_one_root() -> None:
    hits = unit_cone().intersect(Pose(np.eye(3), np.array([-4.0, 0, 0])), np.array([[1.0, 0, 1]]))
    assert np.array_equal(hits.depths_mm[0], [2.0, np.nan], equal_nan=True) or np.array_equal(
        hits.depths_mm[0], [np.nan, 2.0], equal_nan=True
    )
    assert hits.valid.sum() == 1 and not hits.tangent[0]


def test_rays_from_the_apex_or_along_the_cone_have_defined_answers() -> None:
    cone = unit_cone()
    # From the apex: the only root is the apex itself, which lies in front of nobody.
    hits = cone.intersect(Pose.identity(), np.array([[0.0, 0, 1], [2.0, 0, 1]]))
    assert not hits.valid.any()
    # Along a line of the cone: every depth solves the equation, none is the answer.
    hits = cone.intersect(Pose(np.eye(3), np.array([2.0, 0, 2])), np.array([[1.0, 0, 1]]))
    assert np.isnan(hits.depths_mm).all() and not hits.valid.any() and not hits.tangent.any()


def test_roots_behind_a_camera_are_not_valid() -> None:
    cone = unit_cone()
    back = np.diag([-1.0, 1, -1])
    # Looking back through the cone from z = 10: two points in front of the ray camera, one behind the cone camera.
    hits = cone.intersect(Pose(back, np.array([0.5, 0, 10.0])), np.array([[0.0, 0, 1]]))
    assert hits.depths_mm[0] == pytest.approx([9.5, 10.5])
    assert hits.valid[0].tolist() == [True, False]
    # Looking away from it: both behind the ray camera.
    hits = cone.intersect(Pose(np.eye(3), np.array([0.5, 0, 10.0])), np.array([[0.0, 0, 1]]))
    assert (hits.depths_mm[0] < 0).all() and not hits.valid.any()


@few
@given(rigs(), st.floats(0, 2 * np.pi), st.floats(0, 0.5))
def test_straight_tubes_meet_the_plane_of_their_line(rig: Rig, azimuth: float, tilt: float) -> None:
    """The cone over a double line is a plane, met once; the answer comes twice and counts as tangent."""
    turned = Pose.from_rotvec([-tilt * np.sin(azimuth), tilt * np.cos(azimuth), 0], np.zeros(3))
    moved = Rig(rig.cameras, {n: p @ turned for n, p in rig.camera_from_base.items()})
    s = sight(moved, Arc(0.0, 0.0, LENGTH_MM))
    assume(s.crossing > USABLE_CROSSING)
    for conic in (fit_line(s.arc), fit_taubin(s.arc)):
        assert conic.kind == "line"
        hits = Cone(conic).intersect(s.cone_from_ray, s.rays)
        assert hits.tangent.all() and hits.valid.all()
        # No square root here: eta / sweep with eta = 10 eps.
        assert (np.abs(hits.depths_mm / s.depths_mm[:, None] - 1) * s.sweep[:, None]).max() < 1e-13


def test_rays_of_the_plane_itself_have_no_root() -> None:
    plane = Cone(Conic.from_matrix(np.diag([0.0, 1, 0])))
    v = np.array([[0.2, 0.0, 1.0], [0.0, 0.5, 1.0]])
    inside = plane.intersect(Pose(np.eye(3), np.array([-50.0, 0, 0])), v[:1])
    parallel = plane.intersect(Pose(np.eye(3), np.array([-50.0, -20, 0])), v[:1])
    for hits in (inside, parallel):
        assert np.isnan(hits.depths_mm).all() and not hits.valid.any() and not hits.tangent.any()
    crossing = plane.intersect(Pose(np.eye(3), np.array([-50.0, -20, 0])), v[1:])
    assert crossing.depths_mm.tolist() == [[40.0, 40.0]]


@few
@given(st.floats(0.05, 1.5), st.floats(-0.3, 0.3), st.floats(20, 200))
def test_a_pair_of_lines_is_met_in_both_planes(angle: float, x: float, aside: float) -> None:
    """The planes ``x = 0`` and ``x = z tan(angle)``."""
    first, second = np.array([1.0, 0, 0]), np.array([np.cos(angle), 0, -np.sin(angle)])
    pair = Conic.from_matrix(np.outer(first, second) + np.outer(second, first))
    assert pair.kind == "degenerate"
    v, t = np.array([x, 0.1, 1.0]), np.array([-aside, 3.0, 200.0])
    expected = sorted(-(n @ t) / (n @ v) for n in (first, second) if abs(n @ v) > 1e-3)
    assume(len(expected) == 2 and abs(expected[1] - expected[0]) > 1e-3)
    hits = Cone(pair).intersect(Pose(np.eye(3), t), v[None])
    # A share eta of the coefficients against the distance of the roots.
    assert np.allclose(hits.depths_mm[0], expected, rtol=1e-10 * max(map(abs, expected)) / (expected[1] - expected[0]))


def test_an_ellipse_without_points_is_never_met() -> None:
    hits = Cone(Conic.from_matrix(np.eye(3))).intersect(Pose(np.eye(3), np.array([5.0, 0, 1])), np.array([[0.1, 0, 1]]))
    assert np.isnan(hits.depths_mm).all() and not hits.valid.any() and not hits.tangent.any()


@few
@given(seeds, st.integers(2, 30), st.floats(-0.5, 1.5))
def test_places_on_a_polyline(seed: int, count: int, share: float) -> None:
    """A spiral that nowhere comes near itself: points on it, and past its ends."""
    t = np.linspace(0, 1, count)
    arc = np.stack([t, 0.1 * t * t + 0.02 * np.random.default_rng(seed).random()], -1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(arc, axis=0), axis=1))])
    at = share * length[-1]
    inside = float(np.clip(at, 0, length[-1]))
    xy = np.array([np.interp(inside, length, arc[:, k]) for k in (0, 1)])
    end = arc[1] - arc[0] if at < 0 else arc[-1] - arc[-2]
    beyond = at - inside
    place, off = place_along(arc, (xy + beyond * end / np.linalg.norm(end))[None])
    assert place[0] == pytest.approx(at, abs=1e-12)
    assert off[0] == pytest.approx(abs(beyond), abs=1e-12)


def test_places_beside_a_polyline() -> None:
    arc = np.array([[0.0, 0], [1, 0], [1, 0], [1, 1]])  # with a point that came twice
    xy = np.array([[0.3, 0.1], [1.2, 0.5], [1.5, -0.5], [-1, 1], [1, 3], [np.nan, 0]])
    place, off = place_along(arc, xy)
    assert place == pytest.approx([0.3, 1.5, 1.0, -1.0, 4.0, np.nan], nan_ok=True)
    assert off == pytest.approx([0.1, 0.2, np.sqrt(0.5), np.sqrt(2), 2.0, np.nan], nan_ok=True)


@few
@given(st.floats(0, np.pi), st.floats(-1, 1), st.floats(-1, 1), st.floats(0, np.pi / 2))
def test_crossing_of_a_line_is_its_sine(turn: float, x: float, y: float, angle: float) -> None:
    along = np.array([np.cos(turn), np.sin(turn)])
    arc = np.array([x, y]) + np.linspace(0, 0.3, 30)[:, None] * along
    # An epipole at infinity: parallel epipolar lines at an angle to the curve.
    epipole = np.array([np.cos(turn + angle), np.sin(turn + angle), 0.0])
    assert epipolar_crossing(arc, epipole) == pytest.approx(np.sin(angle), abs=1e-12)
    # The epipole at a finite place on the curve's own line: never crossed.
    assert epipolar_crossing(arc, np.array([*(arc[0] - along), 1.0])) == pytest.approx(0, abs=1e-12)


def test_the_view_that_is_crossed_makes_the_cone() -> None:
    """Bent in the plane of the right camera's axis: the right camera sees a line, crossed nowhere squarely enough."""
    centres = {"left": np.array([400.0, 0, 80]), "right": np.array([0.0, 400, 0])}
    found = {n: looking(c, np.array([0, 0, 80.0]), 0.0) for n, c in centres.items()}
    ideal = rig_around(90).cameras["left"]
    s = sight(Rig({"left": ideal, "right": ideal}, found), Arc(1.0, np.pi / 2, LENGTH_MM))
    assert s.crossing > USABLE_CROSSING
    check_roots(s)
