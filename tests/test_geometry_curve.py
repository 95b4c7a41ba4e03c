"""Curves by arc length, and the numbers a user asks of them."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import ellipeinc

from geometry_scenes import Array, few, poses, triples
from tubesight.geometry.curve import Arc, Curve3D, EllipseArc, NodeCurve
from tubesight.geometry.pose import Pose
from tubesight.geometry.shape import SD_NAMES, angle_between, shape_of
from tubesight.simulate import Arc as ArcPhantom
from tubesight.simulate import Helix

lengths = st.floats(20, 300)
curvatures = st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)).map(np.array)
arcs = st.builds(Arc, curvatures, lengths, poses)


@st.composite
def ellipse_arcs(draw: st.DrawFn) -> EllipseArc:
    """Arcs of ellipses of any place, axis ratios up to 10, either way round, up to a full turn."""
    pose, a = draw(poses), draw(st.floats(50, 500))
    start, span = draw(st.floats(-7, 7)), draw(st.floats(0.1, 6)) * draw(st.sampled_from([-1, 1]))
    b = a * draw(st.floats(0.1, 1))
    return EllipseArc(pose.translation_mm, a * pose.rotation[:, 0], b * pose.rotation[:, 1], start, start + span)


curves = st.one_of(arcs, ellipse_arcs())


@few
@given(curves)
def test_arc_length_is_arc_length(curve: Curve3D) -> None:
    """``|dp/ds| = 1`` and the tangent is the derivative, base to tip."""
    s = np.linspace(0, curve.length_mm, 41)
    step = 1e-5 * curve.length_mm
    inner = s[1:-1]
    moved = (curve.at(inner + step) - curve.at(inner - step)) / (2 * step)
    # Central differences: step^2 / 6 times the second derivative of the tangent. The sharpest ellipse, 1 : 10 and 4 a
    # round, has a curvature of 100 / a, which makes (4e-5 a)^2 / 6 * (100 / a)^2 = 3e-6, and its change about as much.
    assert np.allclose(moved, curve.tangent(inner), rtol=0, atol=2e-5)
    assert np.allclose(np.linalg.norm(curve.tangent(s), axis=1), 1, rtol=0, atol=1e-14)


@few
@given(ellipse_arcs())
def test_ellipse_arcs_have_the_length_of_the_integral(curve: EllipseArc) -> None:
    a, b = np.linalg.norm(curve.a_mm), np.linalg.norm(curve.b_mm)

    def speed(t: float) -> float:
        return float(np.hypot(a * np.sin(t), b * np.cos(t)))

    ends = sorted((curve.start_rad, curve.end_rad))
    corners = [k * np.pi / 2 for k in range(-10, 11) if ends[0] < k * np.pi / 2 < ends[1]]
    expected, _ = quad(speed, *ends, points=corners or None, epsabs=0, epsrel=1e-12, limit=200)
    assert curve.length_mm == pytest.approx(expected, rel=1e-11)
    # The same by Legendre: s = b E(t, m), measured from where b cos t = b.
    m = 1 - (a / b) ** 2
    assert curve.length_mm == pytest.approx(abs(b * (ellipeinc(ends[1], m) - ellipeinc(ends[0], m))), rel=1e-9)


@few
@given(ellipse_arcs(), st.floats(0, 1))
def test_points_of_ellipse_arcs_lie_where_their_arc_length_says(curve: EllipseArc, share: float) -> None:
    s = share * curve.length_mm
    t = float(curve._parameter(np.array(s)))
    assume(abs(t - curve.start_rad) > 1e-9)
    part = EllipseArc(curve.centre_mm, curve.a_mm, curve.b_mm, curve.start_rad, t)
    # Newton to rounding of the parameter, some 1e-15, times a speed of up to 500 mm.
    assert part.length_mm == pytest.approx(s, abs=1e-11)
    local = curve.at([s])[0] - curve.centre_mm
    x, y = local @ curve.a_mm / (curve.a_mm @ curve.a_mm), local @ curve.b_mm / (curve.b_mm @ curve.b_mm)
    assert x * x + y * y == pytest.approx(1, abs=1e-12)


@few
@given(st.floats(50, 500), st.floats(0.1, 5.5), poses)
def test_a_round_ellipse_is_a_circle(radius: float, span: float, pose: Pose) -> None:
    """Leaving along +z, bending towards +x: centre on +x."""
    x, z = pose.rotation[:, 0], pose.rotation[:, 2]
    ellipse = EllipseArc(pose.translation_mm + radius * x, -radius * x, radius * z, 0.0, span)
    arc = Arc(np.array([1 / radius, 0]), radius * span, pose)
    s = np.linspace(0, arc.length_mm, 9)
    assert ellipse.length_mm == pytest.approx(arc.length_mm, rel=1e-12)
    assert np.allclose(ellipse.at(s), arc.at(s), rtol=0, atol=1e-9)
    assert np.allclose(ellipse.tangent(s), arc.tangent(s), rtol=0, atol=1e-11)


@few
@given(arcs)
def test_arcs_are_circles(arc: Arc) -> None:
    """All points at the radius from the centre, and the turn is curvature times length."""
    kappa = float(np.hypot(*arc.curvature_per_mm))
    assume(kappa > 1e-5)
    centre = arc.start.apply(np.append(arc.curvature_per_mm / kappa**2, 0))
    points = arc.at(np.linspace(0, arc.length_mm, 15))
    # The centre is up to 1e5 mm away.
    assert np.allclose(np.linalg.norm(points - centre, axis=1), 1 / kappa, rtol=0, atol=1e-15 * 1e5 * 10)
    assert np.allclose(arc.at([0.0])[0], arc.start.translation_mm, rtol=0, atol=1e-12)
    assert np.allclose(arc.tangent([0.0])[0], arc.start.rotation[:, 2], rtol=0, atol=1e-15)
    turned = kappa * arc.length_mm
    ends = arc.tangent([0.0, arc.length_mm])
    assert ends[0] @ ends[1] == pytest.approx(np.cos(turned), abs=1e-13)


@few
@given(st.floats(-16, -3), st.floats(0, 2 * np.pi), lengths)
def test_the_straight_line_is_the_limit(exponent: float, azimuth: float, length: float) -> None:
    """To first order in the curvature the sag is ``kappa s^2 / 2`` and nothing else happens."""
    kappa = 10.0**exponent / length
    direction = np.array([np.cos(azimuth), np.sin(azimuth)])
    bent, straight = Arc(kappa * direction, length), Arc(np.zeros(2), length)
    s = np.linspace(0, length, 9)
    sag = bent.at(s) - straight.at(s)
    # The next order is kappa^2 s^3 / 6 along z, kappa^3 s^4 / 24 across.
    assert np.allclose(sag[:, :2], kappa * s[:, None] ** 2 / 2 * direction, rtol=1e-6, atol=1e-13)
    assert np.allclose(sag[:, 2], 0, rtol=0, atol=kappa**2 * length**3 / 6 + 1e-12)
    assert (straight.model, bent.model) == ("line", "circle")
    assert straight.length_mm == bent.length_mm == length


@few
@given(st.floats(0, 3), st.floats(0, 6.3), lengths)
def test_arcs_are_the_simulators(theta: float, phi: float, length: float) -> None:
    phantom = ArcPhantom(theta, phi, length)
    arc = Arc(theta / length * np.array([np.cos(phi), np.sin(phi)]), length)
    s = np.linspace(0, length, 9)
    assert np.allclose(arc.at(s), phantom.at(s), rtol=0, atol=1e-11)
    assert np.allclose(arc.tangent(s), phantom.tangent(s), rtol=0, atol=1e-13)


def test_an_ellipse_needs_orthogonal_axes_and_a_way_to_go() -> None:
    x, y = np.eye(3)[:2] * 10
    with pytest.raises(ValueError, match="orthogonal"):
        EllipseArc(np.zeros(3), x, y + 0.1 * x, 0, 1)
    with pytest.raises(ValueError, match="differ"):
        EllipseArc(np.zeros(3), x, y, 1.0, 1.0)


@few
@given(arcs)
def test_node_curves_follow_what_they_sample(arc: Arc) -> None:
    s = np.linspace(0, arc.length_mm, 65)
    nodes = NodeCurve("circle", s, arc.at(s), arc.tangent(s))
    between = np.linspace(0, arc.length_mm, 200)
    # Cubic Hermite: h^4 / 384 times the fourth derivative kappa^3; h = 4.7 mm, kappa = 0.029 / mm: 3e-5 mm.
    assert np.allclose(nodes.at(between), arc.at(between), rtol=0, atol=1e-4)
    # Its derivative: h^3 / 125 times kappa^3.
    assert np.allclose(nodes.tangent(between), arc.tangent(between), rtol=0, atol=5e-5)
    assert nodes.length_mm == arc.length_mm


# Shapes --------------------------------------------------------------------------------------------------------------


@few
@given(st.floats(0.01, np.pi - 0.01), st.floats(0, 2 * np.pi, exclude_max=True), lengths)
def test_shape_of_an_arc(theta: float, phi: float, length: float) -> None:
    shape = shape_of(Arc(theta / length * np.array([np.cos(phi), np.sin(phi)]), length), 1e-6)
    chord = length * np.sinc(theta / 2 / np.pi)
    side = chord * np.sin(theta / 2)
    expected = [side * np.cos(phi), side * np.sin(phi), chord * np.cos(theta / 2)]
    assert np.allclose(shape.tip_mm, expected, rtol=0, atol=1e-11)
    assert shape.bending_rad == pytest.approx(theta, abs=1e-12)
    off = (shape.orientation_rad - phi + np.pi) % (2 * np.pi) - np.pi
    assert abs(off) < 1e-11
    assert 0 <= shape.orientation_rad < 2 * np.pi
    assert shape.length_mm == length
    assert shape.curvature_per_mm == pytest.approx(theta / length, rel=1e-11)
    assert set(shape.sd) == set(SD_NAMES) and np.isnan(list(shape.sd.values())).all()


@few
@given(st.floats(0, 2 * np.pi, exclude_max=True), st.floats(-14, -2))
def test_small_bends_are_measured_to_the_last_digit(phi: float, exponent: float) -> None:
    """arccos of a product of tangents would stop at 1e-8."""
    theta = 10.0**exponent
    shape = shape_of(Arc(theta / 160 * np.array([np.cos(phi), np.sin(phi)]), 160.0), 0.0)
    assert shape.bending_rad == pytest.approx(theta, rel=1e-6, abs=0)


def test_shape_of_a_straight_tube() -> None:
    shape = shape_of(Arc(np.zeros(2), 160.0), 0.0)
    assert (shape.bending_rad, shape.length_mm, shape.curvature_per_mm) == (0, 160, 0)
    assert shape.tip_mm.tolist() == [0, 0, 160]
    assert np.isnan(shape.orientation_rad)


def test_orientation_is_undefined_near_the_axis_and_not_for_a_small_bend() -> None:
    arc = Arc(np.array([0, 1e-4]), 100.0)  # bent by 0.01 rad, tip 0.5 mm off the axis
    assert shape_of(arc, 0.4).orientation_rad == pytest.approx(np.pi / 2)
    assert np.isnan(shape_of(arc, 0.6).orientation_rad)


def test_orientation_folds_into_one_turn() -> None:
    """The rounding below zero is zero, not a full turn."""
    assert shape_of(Arc(np.array([0.005, -1e-22]), 100.0), 1e-6).orientation_rad == 0
    assert shape_of(Arc(np.array([0.005, -1e-6]), 100.0), 1e-6).orientation_rad == pytest.approx(2 * np.pi - 2e-4)


def test_shape_of_an_s_curve() -> None:
    """Two arcs against each other: the ends are parallel, the bend is zero, the curvature is not."""
    first = Arc(np.array([0.01, 0.0]), 80.0)
    turn = Pose.from_rotvec([0, 0.8, 0], first.at([80.0])[0])
    second = Arc(np.array([-0.01, 0.0]), 80.0, turn)
    s = np.linspace(0, 80, 33)
    points = np.vstack([first.at(s), second.at(s)[1:]])
    tangents = np.vstack([first.tangent(s), second.tangent(s)[1:]])
    shape = shape_of(NodeCurve("arcs2", np.linspace(0, 160, 65), points, tangents), 0.01)
    assert shape.bending_rad == pytest.approx(0, abs=1e-9)
    assert shape.orientation_rad == pytest.approx(0, abs=1e-12)
    assert shape.curvature_per_mm == pytest.approx(0.01, rel=1e-9)
    assert shape.tip_mm[0] == pytest.approx(2 * 100 * (1 - np.cos(0.8)))


def test_shape_of_a_helix() -> None:
    """Constant curvature in space: the sum of turns is curvature times length, whatever the ends do."""
    helix = Helix(0.02, 0.01, 0.3, 160.0)
    s = np.linspace(0, 160, 400)
    shape = shape_of(NodeCurve("spatial", s, helix.at(s), helix.tangent(s)), 0.01)
    # The turn between neighbouring tangents falls short of kappa s by (tau s)^2 / 24 of itself, s = 2.5 mm.
    assert shape.curvature_per_mm == pytest.approx(0.02, rel=1e-4)
    assert shape.bending_rad == pytest.approx(angle_between(*helix.tangent([0.0, 160.0])), abs=1e-9)


@few
@given(arcs, triples(1.0), st.floats(0, 2 * np.pi))
def test_shapes_turn_with_their_frame(arc: Arc, axis: Array, turn: float) -> None:
    """What does not depend on the frame does not change; a turn about z adds to the orientation."""
    about_z = Pose.from_rotvec([0, 0, turn], np.zeros(3))
    here = shape_of(arc, 1e-3)
    there = shape_of(Arc(arc.curvature_per_mm, arc.length_mm, about_z @ arc.start), 1e-3)
    for name in ("bending_rad", "length_mm", "curvature_per_mm"):
        assert getattr(there, name) == pytest.approx(getattr(here, name), rel=1e-9, abs=1e-12)
    assert np.allclose(there.tip_mm, about_z.apply(here.tip_mm), rtol=0, atol=1e-10)
    if np.isfinite(here.orientation_rad):
        off = (there.orientation_rad - here.orientation_rad - turn + np.pi) % (2 * np.pi) - np.pi
        # Rounding of 1e-13 mm over the distance from the axis.
        assert abs(off) < 1e-12 + 1e-11 / np.hypot(*here.tip_mm[:2])


def test_deviations_are_what_the_displaced_curves_change() -> None:
    s = np.linspace(0, 100.0, 65)

    def curve(kappa: float, azimuth: float, length: float) -> NodeCurve:
        arc = Arc(kappa * np.array([np.cos(azimuth), np.sin(azimuth)]), length)
        at = s * length / 100
        return NodeCurve("circle", at, arc.at(at), arc.tangent(at))

    moved = (curve(0.01, 0.002, 100.0), curve(0.01, 0.0, 100.3))
    found = shape_of(
        NodeCurve("circle", s, curve(0.01, 0, 100).points_mm, curve(0.01, 0, 100).tangents, moved, moved[:1]), 0.01
    )
    assert found.sd_picture["length"] == pytest.approx(0.3)
    assert found.sd_picture["orientation"] == pytest.approx(0.002)
    assert found.sd_rig["orientation"] == pytest.approx(0.002)
    assert found.sd["orientation"] == pytest.approx(np.hypot(0.002, 0.002))
    assert found.sd_rig["length"] == pytest.approx(0, abs=1e-9)
    # theta = kappa length: 0.003 rad of bending for 0.3 mm more of the same curvature.
    assert found.sd["bending"] == pytest.approx(0.003, rel=1e-6)
    # Across the axis the tip moves by 46 mm * 0.002 = 0.09 mm and by 0.25 mm: no orientation under three of that.
    close = NodeCurve("line", s, np.stack([0 * s, 0 * s + 1e-3 * s, s], -1), np.tile([0.0, 0, 1], (65, 1)), moved)
    assert np.isnan(shape_of(close, 0.01).orientation_rad) and np.isnan(shape_of(close, 0.01).sd["orientation"])


@few
@given(triples(1.0), triples(1.0))
def test_angle_between(a: Array, b: Array) -> None:
    assume(np.linalg.norm(a) > 0.1 and np.linalg.norm(b) > 0.1)
    cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
    # The cosine knows an angle to the square root of rounding near 0 and pi.
    assert angle_between(a, b) == pytest.approx(np.arccos(np.clip(cosine, -1, 1)), abs=1e-7)
    assert angle_between(a, a) == pytest.approx(0, abs=1e-15)
    assert angle_between(a, -a) == pytest.approx(np.pi)
