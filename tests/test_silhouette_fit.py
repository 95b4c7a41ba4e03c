"""The silhouette fit on exact silhouettes: right family, right numbers, honest deviations."""

from dataclasses import replace

import numpy as np
import pytest

from fit_scenes import DOUBT_PX, curve, views_of
from tubesight.core import Tip, Tube
from tubesight.geometry.curve import NodeCurve
from tubesight.geometry.families import FAMILIES, Nodes, ellipse_like, nodes_of
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig, RigCovariance
from tubesight.geometry.shape import shape_of
from tubesight.methods import METHODS
from tubesight.methods.rays import deviations
from tubesight.simulate import rig_around
from tubesight.vision.view import View

RIG = rig_around(90.0, size_px=(1920, 1080))
BALL = Tube(12.0, Tip("ball", 16.0), clamped=True)
ROUND = Tube(12.0, Tip("round"), clamped=True)
FREE = Tube(12.0, Tip("round"))
SHAPES = {
    "circle": [0.5, 0.3, 150.0],
    "ellipse": [0.5, 0.3, 0.5, 0.3, 150.0],
    "polynomial2": [0.4, 0.4, 0.9, 0.3, 150.0],
    "arcs2": [0.6, 0.2, -0.5, 0.3, 0.2, 150.0],
    "spatial2": [0.4, 0.3, 0.3, -0.4, 0.2, 0.1, 150.0],
    "arcs3": [0.6, 0.2, -0.5, 0.3, 0.4, -0.4, 0.1, -0.1, 160.0],
}


def measured(nodes: Nodes, tube: Tube, rig: Rig = RIG, **noise: object) -> NodeCurve:
    found = METHODS["silhouette"].solve(views_of(nodes, rig, tube, **noise), rig, tube)  # type: ignore[arg-type]
    assert isinstance(found, NodeCurve)
    return found


@pytest.mark.parametrize("tube", [BALL, ROUND, FREE], ids=["ball", "round", "free"])
@pytest.mark.parametrize("name", SHAPES)
def test_exact_silhouettes_give_the_curve_back(name: str, tube: Tube) -> None:
    """Also S-shapes without a clamp, on which the closed form fails.

    1e-3 mm: steps end below 2e-3 mm and shrink by a factor of 3 or more each; 0.02 mm for the three pieces, which end
    slower.
    """
    nodes = curve(name, SHAPES[name])
    found = measured(nodes, tube)
    assert found.model == name
    assert np.abs(found.points_mm[-1] - nodes.points[-1]).max() < 1e-3
    assert found.length_mm == pytest.approx(nodes.s_mm[-1], abs=1e-3)
    assert np.abs(found.tangents[-1] - nodes.tangents[-1]).max() < 1e-4


@pytest.mark.parametrize("name", ["circle", "ellipse", "arcs2"])
def test_flat_ends(name: str) -> None:
    """1e-3 mm: the rim of the end face is a polygon of 144 corners."""
    nodes = curve(name, SHAPES[name])
    found = measured(nodes, Tube(12.0, Tip("flat"), clamped=True))
    assert found.model == name
    assert np.abs(found.points_mm[-1] - nodes.points[-1]).max() < 1e-3


def test_a_plane_curve_that_bends_back_and_forth() -> None:
    """An S in a plane ends parallel to its base: no circle is near it."""
    nodes = curve("arcs2", [0.5, 0.5, -0.5, -0.5, 0.0, 150.0])
    for tube in (BALL, FREE):
        found = measured(nodes, tube)
        assert found.model == "arcs2"
        assert np.abs(found.points_mm[-1] - nodes.points[-1]).max() < 1e-3


def test_unknown_diameter_is_found() -> None:
    nodes = curve("circle", SHAPES["circle"])
    views = views_of(nodes, RIG, BALL)
    found = METHODS["silhouette"].solve(views, RIG, Tube(None, Tip("ball", 16.0), clamped=True))
    # The prior on the guessed radius (a fifth) pulls by a millionth of it.
    assert np.abs(found.at([found.length_mm])[0] - nodes.points[-1]).max() < 5e-3


def test_bends_fade_into_straight_without_a_jump() -> None:
    """From 5 degrees to none, with one and the same noise: what the tip is off moves by under 0.02 mm in all."""
    off, shapes = [], []
    for theta in np.linspace(5.0, 0.0, 26):
        nodes = curve("circle", [*(np.radians(theta) * np.array([0.6, 0.8])), 150.0])
        found = measured(nodes, BALL, noise_px=0.05, rng=np.random.default_rng(3))
        assert found.model == "circle"
        off.append(found.points_mm[-1] - nodes.points[-1])
        shapes.append(shape_of(found, 0.0))
    assert np.ptp(off, axis=0).max() < 0.02
    assert np.isnan(shapes[-1].orientation_rad), "the azimuth of a straight tube is not known"
    known = [np.degrees(s.orientation_rad) for s in shapes if not np.isnan(s.orientation_rad)]
    assert len(known) > 15
    # The tip leaves the axis by three deviations at least: 19 degrees.
    np.testing.assert_allclose(known, np.degrees(np.arctan2(0.8, 0.6)), atol=19)


@pytest.mark.parametrize("shaded", [True, False], ids=["shaded", "noise"])
@pytest.mark.parametrize("name", ["circle", "arcs2"])
def test_deviations_are_honest(name: str, shaded: bool) -> None:
    """Normalised errors of the tip under noise, and under shading as large as expected: their mean square is 1.

    Bias of the views and clamp are expected but absent here, so that it may be smaller. 40 draws of 3 nearly
    independent numbers scatter by sqrt(2 / 120) = 0.13: four of them above 1.
    """
    nodes = curve(name, SHAPES[name])
    # What `rays.deviations` expects of rows of this roughness, where their measurements disagree by `DOUBT_PX`.
    shading_px = float(np.hypot(0.04, DOUBT_PX + 0.7 * 0.06)) if shaded else 0.0
    squares = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        found = measured(nodes, BALL, noise_px=0.06, rng=rng, shading_px=shading_px)
        displaced = np.array([c.points_mm[-1] for c in found.from_picture]) - found.points_mm[-1]
        squares.append((found.points_mm[-1] - nodes.points[-1]) ** 2 / (displaced**2).sum(0))
    assert 0.3 < np.mean(squares) < 1.5


def test_rows_that_agree_are_charged_with_less() -> None:
    """From agreeing rows to disagreeing ones what a row may be moved by grows, and so it does with their roughness."""
    lobes = [deviations(np.full(2, 0.06), 0.06, np.full(2, doubt), doubt)[1] for doubt in (0.0, 0.005, 0.01, 0.02)]
    assert (np.diff(lobes, axis=0) > 0).all()
    # Less than a quarter of what the same row is charged with where its measurements disagree.
    assert lobes[0][0] < 0.25 * lobes[2][0]
    smooth, rough = (deviations(np.full(2, r), r, np.zeros(2), 0.0)[1][0] for r in (0.1, 0.2))
    assert rough > 10 * smooth, "what roughens a row also moves it, however well its measurements agree"


def test_calibration_counts() -> None:
    """A principal point known to 1 px moves edges and tip alike: as much as pictures seen with a moved one tell."""
    names = ("left.cx", "right.cx")
    rig = Rig(RIG.cameras, RIG.camera_from_base, covariance=RigCovariance(names, np.eye(2)))
    nodes = curve("circle", SHAPES["circle"])
    found = measured(nodes, BALL, rig)
    displaced = np.array([c.points_mm[-1] for c in found.from_rig]) - found.points_mm[-1]
    squares = np.zeros(3)
    for name in names:
        moved = rig.perturbed(name, 0.5)
        there = METHODS["silhouette"].solve(_seen_by(views_of(nodes, RIG, BALL), moved), moved, BALL)
        squares += ((there.at([there.length_mm])[0] - found.points_mm[-1]) / 0.5) ** 2
    # Half a pixel is not quite linear: robust weights change with it.
    np.testing.assert_allclose(np.sqrt((displaced**2).sum(0)), np.sqrt(squares), rtol=0.1, atol=0.01)


def _seen_by(views: dict[str, View], rig: Rig) -> dict[str, View]:
    """Return the same pixels through another calibration."""
    again = {}
    for name, view in views.items():
        rays = rig.cameras[name].unproject(view.edges_px)
        axis = rig.cameras[name].unproject(view.tip.px)
        tip = replace(view.tip, axis=axis / np.linalg.norm(axis))
        again[name] = replace(view, edge_rays=rays / np.linalg.norm(rays, axis=-1, keepdims=True), tip=tip)
    return again


def test_ellipse_like_a_polynomial_keeps_its_curvature() -> None:
    """Exact at start, middle and end of any curve whose curvature an ellipse has there."""
    polynomial = np.array([0.4, 0.8, -0.3, 0.1, 150.0])
    ellipse = nodes_of(FAMILIES["ellipse"], np.append(ellipse_like(polynomial), np.zeros(4)), Pose.identity())
    want = nodes_of(FAMILIES["polynomial2"], np.append(polynomial, np.zeros(4)), Pose.identity())
    got = np.linalg.norm(ellipse.curvature, axis=1)
    expected = np.linalg.norm(want.curvature, axis=1)
    # Equal ratios at both ends; the scale follows from the length.
    assert got[0] / got[-1] == pytest.approx(expected[0] / expected[-1], rel=1e-9)
    straight = ellipse_like(np.array([0.4, 0.0, 0.0, 0.0, 150.0]))
    np.testing.assert_array_equal(straight[:4], 0.0)
