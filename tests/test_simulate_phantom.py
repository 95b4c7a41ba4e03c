"""Phantoms: curves by arc length, and the conventions of truth.json."""

import json

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from shared_data import shared
from tubesight.geometry.pose import Pose
from tubesight.simulate import Arc, CurvaturePolynomial, EllipseArc, Helix, Phantom, Pieces, Placed, straight, truth

angle = st.floats(0.02, 3.0)
azimuth = st.floats(-np.pi, np.pi)
length = st.floats(20.0, 300.0)
arcs = st.builds(Arc, angle, azimuth, length)
phantoms = st.one_of(
    arcs,
    st.builds(straight, length),
    st.builds(EllipseArc, angle, st.floats(0.3, 3.0), azimuth, length),
    st.lists(arcs, min_size=1, max_size=3).map(lambda a: Pieces(tuple(a))),
    st.builds(
        CurvaturePolynomial, st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.just(0.004)), azimuth, length
    ),
    st.builds(Helix, st.floats(1e-3, 0.03), st.floats(-0.03, 0.03), azimuth, length),
)


def from_description(shape: dict) -> Phantom:
    """Make the phantom of a frame of the mock-up's truth.json, 160 mm long."""
    rad = np.radians
    match shape["kind"]:
        case "circle":
            return Arc(rad(shape["theta"]), rad(shape["phi"]), 160.0)
        case "ellipse":
            return EllipseArc(rad(shape["theta"]), shape["ratio"], rad(shape["phi"]), 160.0)
        case "straight":
            return straight(160.0)
        case _:
            return Pieces(tuple(Arc(rad(a["theta"]), rad(a["phi"]), a["length"]) for a in shape["segments"]))


def test_mockup_truth_is_reproduced() -> None:
    """Every frame of the mock-up, whose truth was made by other code."""
    frames = json.loads((shared("mockup") / "truth.json").read_text())["frames"]
    assert {f["kind"] for f in frames} == {"circle", "ellipse", "straight", "segments"}
    for frame in frames:
        mine = truth(from_description(frame["shape"]))
        # The file holds 5 decimals, and lengths of polylines 6e-6 mm short.
        np.testing.assert_allclose(mine["centreline"], frame["centreline"], rtol=0, atol=2e-5)
        np.testing.assert_allclose(mine["tip"], frame["tip"], rtol=0, atol=1e-6)
        assert mine["length"] == pytest.approx(frame["length"], abs=1e-5)
        assert mine["theta"] == pytest.approx(frame["theta"], abs=1e-9)
        assert mine["phi"] == pytest.approx(frame["phi"], abs=1e-9)
        assert mine["kind"] == frame["kind"]


@given(phantoms)
@example(EllipseArc(1.5625, 0.3046875, 0.0, 20.0))  # Newton's steps alone go to and fro there
@settings(max_examples=60, deadline=None)
def test_parameter_is_arc_length_and_tangent_its_derivative(phantom: Phantom) -> None:
    s = np.linspace(0, phantom.length_mm, 41)
    tangent = phantom.tangent(s)
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=1), 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(phantom.at(s[:1]), 0, atol=1e-12)
    np.testing.assert_allclose(tangent[0], (0, 0, 1), atol=1e-12)
    # Central differences of step h err by h^2 / 6 times the tangent's second derivative, below 3 / mm^2 at the sharpest
    # vertex drawn: 5e-7. Where pieces meet the curvature jumps, and the error is h / 2 times the jump: 1e-3 * 0.15.
    h = 1e-3
    inner = s[1:-1]
    numeric = (phantom.at(inner + h) - phantom.at(inner - h)) / (2 * h)
    np.testing.assert_allclose(numeric, tangent[1:-1], rtol=0, atol=2e-4 if phantom.kind == "segments" else 5e-7)


@pytest.mark.parametrize("ratio", [0.25, 0.5, 2.0, 4.0])
def test_ellipse_lies_on_an_ellipse_and_has_its_length(ratio: float) -> None:
    """Against the implicit equation and against quadrature of its own parametrisation."""
    phantom = EllipseArc(2.0, ratio, 0.0, 100.0)
    points = phantom.at(np.linspace(0, 100, 200))
    a, b = phantom.axial_mm, phantom.axial_mm / ratio
    np.testing.assert_allclose((points[:, 2] / a) ** 2 + ((points[:, 0] - b) / b) ** 2, 1.0, rtol=0, atol=1e-12)
    end = np.arctan2(points[-1, 2] / a, 1 - points[-1, 0] / b)
    arc, _ = quad(lambda t: np.hypot(a * np.cos(t), b * np.sin(t)), 0, end, epsabs=1e-10)
    assert arc == pytest.approx(100.0, abs=1e-8)
    assert truth(phantom)["theta"] == pytest.approx(np.degrees(2.0), abs=1e-9)


def test_curvature_polynomial_against_fine_quadrature() -> None:
    """A turn of 340 degrees with two changes of curvature: the 48 nodes are exact."""
    phantom = CurvaturePolynomial((0.02, 0.03, -0.02, 0.01), 0.3, 300.0)

    def turned(s: float) -> float:
        return quad(lambda u: np.polynomial.legendre.legval(2 * u / 300 - 1, (0.02, 0.03, -0.02, 0.01)), 0, s)[0]

    radial, _ = quad(lambda s: np.sin(turned(s)), 0, 300, epsabs=1e-9, limit=200)
    axial, _ = quad(lambda s: np.cos(turned(s)), 0, 300, epsabs=1e-9, limit=200)
    expected = (radial * np.cos(0.3), radial * np.sin(0.3), axial)
    np.testing.assert_allclose(phantom.at(300.0), expected, rtol=0, atol=1e-7)


def test_families_agree_where_they_meet() -> None:
    """An arc is a circle-shaped ellipse, a polynomial of order zero, one piece, a helix without torsion."""
    s = np.linspace(0, 160, 50)
    arc = Arc(1.2, 0.7, 160.0)
    halves = Pieces((Arc(0.6, 0.7, 80.0), Arc(0.6, 0.7, 80.0)))
    others = (EllipseArc(1.2, 1.0, 0.7, 160.0), CurvaturePolynomial((1.2 / 160,), 0.7, 160.0), halves)
    # A vanishing torsion leaves the bending plane by torsion * s^2: 1e-13 * 160^2.
    for other in (*others, Helix(1.2 / 160, 1e-13, 0.7, 160.0)):
        np.testing.assert_allclose(other.at(s), arc.at(s), rtol=0, atol=1e-8)
        np.testing.assert_allclose(other.tangent(s), arc.tangent(s), rtol=0, atol=1e-8)


def test_straight_is_the_limit_of_the_arc() -> None:
    s = np.linspace(0, 160, 50)
    # A bend of 1e-9 moves the tip by theta * length / 2 = 8e-8.
    np.testing.assert_allclose(Arc(1e-9, 0.7, 160.0).at(s), straight(160.0).at(s), rtol=0, atol=1e-7)
    assert truth(straight(160.0))["phi"] == 0.0
    assert truth(straight(160.0))["shape"] == {"kind": "straight"}


def test_placed_moves_the_curve_and_keeps_its_bend() -> None:
    arc = Arc(1.0, 0.5, 120.0)
    pose = Pose.from_rotvec((0.3, -0.2, 0.9), (5.0, -7.0, 30.0))
    moved, still = truth(Placed(arc, pose)), truth(arc)
    np.testing.assert_allclose(moved["centreline"], pose.apply(arc.at(np.linspace(0, 120, 101))), rtol=0, atol=1e-6)
    assert moved["theta"] == pytest.approx(still["theta"], abs=1e-9)
    assert moved["length"] == still["length"]
    x, y, _ = moved["tip"]
    assert moved["phi"] == pytest.approx(np.degrees(np.arctan2(y, x)) % 360)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Arc(0.5, 0.0, -1.0), "length_mm: expected a positive number, got -1.0"),
        (lambda: EllipseArc(0.0, 2.0, 0.0, 100.0), "theta_rad: expected between 0 and pi"),
        (lambda: EllipseArc(0.5, 0.0, 0.0, 100.0), "ratio: expected a positive number"),
        (lambda: Pieces(()), "expected at least one arc"),
        (lambda: Helix(0.0, 0.1, 0.0, 100.0), "curvature_per_mm: expected a positive number"),
    ],
)
def test_impossible_phantoms_are_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
