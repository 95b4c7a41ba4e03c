"""Lines, circles and ellipses through points in space: exact on exact points, the same from every frame.

Tolerances: points of 160 mm are rounded to 3e-14 mm, moved ones up to 1 m away to 1e-13 mm. Fits never square that on
exact points; an ellipse whose arc turns by 20 degrees is known worse than its points by 1 / theta^4, two digits.
"""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from geometry_scenes import LENGTH_MM, Array, azimuths, few, poses, seeds
from tubesight.geometry.arcs import (
    bending_plane,
    clamped_arc,
    clamped_ellipse,
    free_arc,
    free_ellipse,
    free_line,
    free_plane,
)
from tubesight.geometry.curve import Arc, Curve3D, EllipseArc
from tubesight.geometry.pose import Pose
from tubesight.simulate import Arc as ArcPhantom
from tubesight.simulate import EllipseArc as EllipsePhantom

EXACT_MM = 1e-10
CONIC_MM = 1e-8
SHARES = np.linspace(0, 1, 33)


def same_curve(found: Curve3D, truth: Curve3D, atol_mm: float) -> None:
    assert found.length_mm == pytest.approx(truth.length_mm, abs=atol_mm)
    s = SHARES * truth.length_mm
    assert np.abs(found.at(s) - truth.at(s)).max() < atol_mm
    assert np.abs(found.tangent(s) - truth.tangent(s)).max() < atol_mm


# Clamped -------------------------------------------------------------------------------------------------------------


@few
@given(st.one_of(st.floats(0, np.pi), st.floats(-12, 0).map(lambda e: 10.0**e)), azimuths, st.floats(20, 300))
def test_clamped_arcs_return_from_their_tips(theta: float, phi: float, length: float) -> None:
    truth = ArcPhantom(theta, phi, length)
    same_curve(clamped_arc(truth.at(length)), truth, EXACT_MM)


def test_clamped_arc_is_straight_on_the_axis() -> None:
    arc = clamped_arc(np.array([0.0, 0, 160]))
    assert arc.model == "line" and arc.length_mm == 160


@pytest.mark.parametrize("tip", [np.zeros(3), np.array([0.0, 0, -5])])
def test_no_clamped_arc_ends_behind_the_clamp(tip: Array) -> None:
    with pytest.raises(ValueError, match="no clamped arc"):
        clamped_arc(tip)


@few
@given(azimuths, st.floats(0.05, 1.5), seeds)
def test_bending_plane_of_a_tube(phi: float, theta: float, seed: int) -> None:
    points = ArcPhantom(theta, phi, LENGTH_MM).at(SHARES * LENGTH_MM)
    weights = np.random.default_rng(seed).uniform(0.1, 1, len(points))
    direction = bending_plane(points, weights)
    assert np.allclose(direction, [np.cos(phi), np.sin(phi)], rtol=0, atol=1e-12)
    turned = bending_plane(points @ Pose.from_rotvec([0, 0, 1.0], np.zeros(3)).rotation.T, weights)
    assert np.allclose(turned, [np.cos(phi + 1), np.sin(phi + 1)], rtol=0, atol=1e-12)


@st.composite
def clamped_ellipses(draw: st.DrawFn, inclined: bool) -> EllipseArc:
    """Elliptic arcs from the origin along +z; inclined ones start anywhere on their ellipse, the others at a vertex."""
    a, b = draw(st.floats(60, 200)), draw(st.floats(60, 200))
    start = draw(st.floats(0, 6)) if inclined else draw(st.sampled_from([0.0, np.pi / 2]))
    span = draw(st.floats(np.radians(30), np.radians(150)))
    phi = draw(azimuths)
    # In the plane: turn the tangent at the start to +z, counter-clockwise rotation bends towards -rho.
    velocity = np.array([-a * np.sin(start), b * np.cos(start)])
    z = velocity / np.linalg.norm(velocity)
    rho = np.array([-z[1], z[0]])  # to the left: where the curve bends
    out = np.array([np.cos(phi), np.sin(phi), 0.0])

    def space(p: Array) -> Array:
        return np.asarray((p @ rho) * out + np.array([0, 0, p @ z]))

    point = np.array([a * np.cos(start), b * np.sin(start)])
    return EllipseArc(-space(point), space(np.array([a, 0])), space(np.array([0, b])), start, start + span)


@pytest.mark.parametrize("inclined", [False, True])
@few
@given(st.data())
def test_clamped_ellipses_return_from_their_points(inclined: bool, data: st.DataObject) -> None:
    """With and without the term ``B rho z``."""
    truth = data.draw(clamped_ellipses(inclined))
    s = SHARES[1:-1] * truth.length_mm
    found = clamped_ellipse(truth.at(s), np.ones(len(s)), truth.at([truth.length_mm])[0])
    same_curve(found, truth, CONIC_MM)
    assert np.abs(found.at([0.0])).max() < CONIC_MM
    assert np.allclose(found.tangent([0.0])[0], [0, 0, 1], rtol=0, atol=1e-9)


@few
@given(st.floats(np.radians(20), np.radians(100)), st.floats(0.4, 2.5), azimuths)
def test_clamped_ellipses_of_the_simulator(theta: float, ratio: float, phi: float) -> None:
    truth = EllipsePhantom(theta, ratio, phi, LENGTH_MM)
    s = SHARES[1:-1] * LENGTH_MM
    found = clamped_ellipse(truth.at(s), np.ones(len(s)), truth.at(LENGTH_MM))
    same_curve(found, truth, CONIC_MM)


@few
@given(st.floats(np.radians(20), np.radians(100)), st.floats(0.5, 2), azimuths, st.floats(0.1, 10), seeds)
def test_clamped_ellipses_scale_and_turn(theta: float, ratio: float, phi: float, scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = EllipsePhantom(theta, ratio, phi, LENGTH_MM)
    points = truth.at(SHARES * LENGTH_MM) + rng.normal(0, 0.02, (33, 3))
    weights = rng.uniform(0.5, 1, 33)
    move = Pose.from_rotvec([0, 0, rng.uniform(0, 6)], np.zeros(3))
    try:
        here = clamped_ellipse(points, weights, points[-1])
    except ValueError:
        assume(False)
    there = clamped_ellipse(scale * move.apply(points), weights, scale * move.apply(points[-1]))
    s = SHARES * here.length_mm
    assert there.length_mm == pytest.approx(scale * here.length_mm, rel=1e-9)
    assert np.allclose(there.at(scale * s), scale * move.apply(here.at(s)), rtol=0, atol=scale * CONIC_MM)


def test_a_clamped_hyperbola_is_refused() -> None:
    """``rho = c (sqrt(1 + (z / d)^2) - 1)``."""
    z = np.linspace(0, 160, 33)
    points = np.stack([40 * (np.sqrt(1 + (z / 60) ** 2) - 1), 0 * z, z], -1)
    with pytest.raises(ValueError, match="not an ellipse"):
        clamped_ellipse(points[1:], np.ones(32), points[-1])


# Free ----------------------------------------------------------------------------------------------------------------


@few
@given(poses, st.floats(20, 300), seeds)
def test_free_lines_return_from_their_points(pose: Pose, length: float, seed: int) -> None:
    truth = Arc(np.zeros(2), length, pose)
    s = SHARES * length
    weights = np.random.default_rng(seed).uniform(0.1, 1, len(s))
    same_curve(free_line(truth.at(s), weights, truth.at([length])[0]), truth, 1e-9)


@few
@given(st.floats(np.radians(1), np.radians(340)), poses, st.floats(20, 300), seeds)
def test_free_arcs_return_from_their_points(theta: float, pose: Pose, length: float, seed: int) -> None:
    """Also those that bend by more than half a turn: the points in between say which way round."""
    truth = Arc(np.array([theta / length, 0.0]), length, pose)
    s = SHARES * length
    weights = np.random.default_rng(seed).uniform(0.1, 1, len(s))
    found = free_arc(truth.at(s), weights, truth.at([length])[0])
    same_curve(found, truth, 1e-9)
    assert found.curvature_per_mm[0] == pytest.approx(theta / length, rel=1e-8)


@pytest.mark.parametrize("off_mm", [-20.0, 5.0, 40.0])
def test_free_arcs_end_at_the_foot_of_the_tip(off_mm: float) -> None:
    """The point of the circle nearest to the tip, also when that is far off."""
    truth = ArcPhantom(1.0, 0.3, LENGTH_MM)
    points = truth.at(SHARES * LENGTH_MM)
    inward = np.cross(truth.tangent(LENGTH_MM), [-np.sin(0.3), np.cos(0.3), 0])
    found = free_arc(points, np.ones(33), points[-1] + off_mm * inward)
    assert np.abs(found.at([found.length_mm])[0] - points[-1]).max() < 1e-9


@few
@given(st.floats(-7, -1), poses)
def test_free_arcs_stay_regular_towards_the_line(exponent: float, pose: Pose) -> None:
    """The centre moves to infinity, the curve does not."""
    theta = 10.0**exponent
    truth = Arc(np.array([theta / LENGTH_MM, 0.0]), LENGTH_MM, pose)
    s = SHARES * LENGTH_MM
    found = free_arc(truth.at(s), np.ones(len(s)), truth.at([LENGTH_MM])[0])
    # Points up to 1 m from the origin are rounded to 1e-13 mm, and so is the plane across: nothing is magnified.
    same_curve(found, truth, 1e-9)


@st.composite
def free_ellipses(draw: st.DrawFn) -> EllipseArc:
    pose, a = draw(poses), draw(st.floats(60, 200))
    b = a * draw(st.floats(0.4, 1))
    start, span = draw(st.floats(0, 6)), draw(st.floats(np.radians(40), np.radians(300)))
    sense = draw(st.sampled_from([-1, 1]))
    return EllipseArc(
        pose.translation_mm, a * pose.rotation[:, 0], b * pose.rotation[:, 1], start, start + sense * span
    )


@few
@given(free_ellipses())
def test_free_ellipses_return_from_their_points(truth: EllipseArc) -> None:
    """Either way round, and beyond half a turn."""
    s = SHARES * truth.length_mm
    found = free_ellipse(truth.at(s), np.ones(len(s)), truth.at([truth.length_mm])[0])
    same_curve(found, truth, CONIC_MM)


@pytest.mark.parametrize("fit", [free_line, free_arc, free_ellipse])
@few
@given(st.floats(np.radians(10), np.radians(120)), poses, poses, st.floats(0.1, 10), seeds)
def test_free_fits_move_and_scale_with_their_points(
    fit: object, theta: float, pose: Pose, move: Pose, scale: float, seed: int
) -> None:
    """With noise, and uneven weights."""
    rng = np.random.default_rng(seed)
    arc = Arc(np.array([theta / LENGTH_MM, 0.0]), LENGTH_MM, pose)
    points = arc.at(SHARES * LENGTH_MM) + rng.normal(0, 0.05, (33, 3))
    weights = rng.uniform(0.5, 1, 33)
    assert callable(fit)
    here = fit(points, weights, points[-1])
    there = fit(scale * move.apply(points), weights, scale * move.apply(points[-1]))
    s = SHARES * here.length_mm
    assert there.length_mm == pytest.approx(scale * here.length_mm, rel=1e-9)
    assert np.allclose(there.at(scale * s), scale * move.apply(here.at(s)), rtol=0, atol=scale * 1e-6)
    assert there.model == here.model


@few
@given(poses, seeds)
def test_the_plane_is_that_of_least_squares(pose: Pose, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = pose.apply(rng.normal(0, 1, (20, 3)) * [50, 20, 1])
    weights = rng.uniform(0.5, 1, 20)
    centre, axes, spread = free_plane(points, weights)
    normal = np.cross(*axes)
    assert axes @ axes.T == pytest.approx(np.eye(2), abs=1e-14)
    assert (np.diff(spread) <= 0).all()
    assert axes[0] @ (points[-1] - points[0]) >= 0

    def squares(c: Array, n: Array) -> float:
        return float((weights**2) @ ((points - c) @ n) ** 2)

    best = squares(centre, normal)
    for step in 0.01 * np.vstack([np.eye(3), -np.eye(3)]):
        assert squares(centre + step, normal) >= best - 1e-9
        tilted = normal + step
        assert squares(centre, tilted / np.linalg.norm(tilted)) >= best - 1e-9


@pytest.mark.parametrize("fit", [free_line, free_arc])
def test_points_without_weight_do_not_count(fit: object) -> None:
    points = ArcPhantom(0.8, 0.3, LENGTH_MM).at(SHARES * LENGTH_MM)
    weights = np.ones(33)
    wild = points.copy()
    wild[10], weights[10] = [30.0, -200, 10], 0
    assert callable(fit)
    same_curve(fit(wild, weights, points[-1]), fit(np.delete(points, 10, 0), np.ones(32), points[-1]), 1e-9)


@pytest.mark.parametrize("fit", [free_arc, free_ellipse])
@few
@given(poses)
def test_no_circle_passes_through_a_line(fit: object, pose: Pose) -> None:
    points = pose.apply(np.stack([0 * SHARES, 0 * SHARES, 160 * SHARES], -1))
    assert callable(fit)
    with pytest.raises(ValueError, match="lie on a line"):
        fit(points, np.ones(33), points[-1])


def test_a_curve_measured_from_its_other_end_is_the_same() -> None:
    truth = Arc(np.array([0.008, 0]), LENGTH_MM, Pose.from_rotvec([1.0, 2, -0.5], [10.0, 20, 30]))
    points = truth.at(SHARES * LENGTH_MM)
    back = free_arc(points[::-1], np.ones(33), points[0])
    s = SHARES * LENGTH_MM
    assert np.abs(back.at(s) - truth.at(LENGTH_MM - s)).max() < EXACT_MM
    assert np.abs(back.tangent(s) + truth.tangent(LENGTH_MM - s)).max() < EXACT_MM


def test_no_ellipse_winds_around_a_straight_tube() -> None:
    """Points of a straight tube that drift: the best conic may be a needle that runs up one side and down the other."""
    z = np.linspace(5.0, 160.0, 28)
    refused = 0
    for seed in range(40):
        xy = np.cumsum(np.random.default_rng(seed).normal(scale=0.01, size=(len(z), 2)), 0)
        try:
            arc = clamped_ellipse(np.column_stack([xy, z]), np.ones(len(z)), np.array([0.0, 0.0, 160.0]))
        except ValueError as error:
            refused += "winds" in str(error)
        else:
            assert arc.length_mm < 1.7 * 160
    assert refused > 0
