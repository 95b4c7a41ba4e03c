"""Methods that match two centrelines: naive triangulation, epipolar matching, and a spline fitted to all views."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fit_scenes import curve, views_of
from test_silhouette_fit import BALL, FREE, RIG, SHAPES
from tubesight.apps.evaluate import distance_to_polyline
from tubesight.core import FramePair, Status, Unmeasurable
from tubesight.geometry import matching_kernels
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.matching import cheapest_way, monotone_way
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import interpolating, smoothing
from tubesight.methods import METHODS
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Arc, Phantom, Pieces, render_pair, rig_around
from tubesight.simulate.rigs import camera_pose

GENERAL = ("epipolar_dp", "spline_fit")


def mean_off_mm(found: Curve3D, points: np.ndarray) -> float:
    return float(distance_to_polyline(found.at(np.linspace(0, found.length_mm, 101)), points).mean())


@pytest.mark.parametrize("name", GENERAL)
@pytest.mark.parametrize("tube", [BALL, FREE], ids=["clamped", "free"])
@pytest.mark.parametrize("shape", SHAPES)
def test_exact_centrelines_give_any_shape_back(shape: str, tube, name: str) -> None:
    """0.1 mm: what a cubic spline within 0.15 px of its points (0.04 mm here) is off, bends of pieces cut short."""
    nodes = curve(shape, SHAPES[shape])
    found = METHODS[name].solve(views_of(nodes, RIG, tube), RIG, tube)
    assert found.model == "spline"
    assert mean_off_mm(found, nodes.points) < 0.1
    assert np.linalg.norm(found.at([found.length_mm])[0] - nodes.points[-1]) < 0.1


@pytest.fixture(scope="module")
def pictures() -> list[tuple[Phantom, FramePair]]:
    """Arcs at a low resolution, half of them where the two views differ most in length, and an S."""
    rig = rig_around(90.0, size_px=(960, 540))
    arcs: list[Phantom] = [Arc(np.radians(t), np.radians(p), 160.0) for t, p in ((30, 45), (50, 180), (70, 270))]
    arcs.append(Pieces((Arc(0.8, 0.7, 80.0), Arc(0.7, 3.5, 80.0))))
    return [(arc, render_pair(rig, arc, BALL, name=str(k))) for k, arc in enumerate(arcs)]


@pytest.mark.parametrize("name", GENERAL)
def test_photographs(name: str, pictures: list[tuple[Phantom, FramePair]]) -> None:
    """0.3 mm: half a pixel at this resolution and distance; centrelines are known to a quarter of one."""
    sensor = ShapeSensor(rig_around(90.0, size_px=(960, 540)), BALL, name)
    for phantom, pair in pictures:
        result = sensor(pair)
        assert result, result.notes
        assert result.curve is not None
        assert mean_off_mm(result.curve, phantom.at(np.linspace(0, phantom.length_mm, 801))) < 0.3


def test_equal_shares_are_not_correspondence(pictures: list[tuple[Phantom, FramePair]]) -> None:
    """Where one view foreshortens the bend and the other does not, pairing by length is millimetres off."""
    sensor = ShapeSensor(rig_around(90.0, size_px=(960, 540)), BALL, "triangulate")
    off = []
    for phantom, pair in pictures:
        result = sensor(pair)
        assert result.curve is not None
        off.append(mean_off_mm(result.curve, phantom.at(np.linspace(0, phantom.length_mm, 801))))
    # Seen alike by both cameras at 45 degrees: both foreshorten by the same share.
    assert off[0] < 0.2
    assert max(off) > 1.5


def test_a_tube_in_the_epipolar_plane_is_refused() -> None:
    """Both cameras and the straight tube lie in one plane: its points along the epipolar line are open."""
    poses = {"left": camera_pose(0, 310, (0, 0, 80)), "right": camera_pose(0, 310, (0, 0, 80), elevation_deg=50)}
    rig = Rig(RIG.cameras, poses)
    views = views_of(curve("circle", [0.0, 0.0, 150.0]), rig, FREE)
    with pytest.raises(Unmeasurable) as caught:
        METHODS["epipolar_dp"].solve(views, rig, FREE)
    assert caught.value.status is Status.NEAR_DEGENERATE


@pytest.mark.parametrize("name", [*GENERAL, "triangulate"])
def test_views_of_different_tubes_are_refused(name: str) -> None:
    one = views_of(curve("circle", [0.5, 0.3, 150.0]), RIG, BALL)
    other = views_of(curve("circle", [-0.9, -0.8, 90.0]), RIG, BALL)
    with pytest.raises(Unmeasurable):
        METHODS[name].solve({"left": one["left"], "right": other["right"]}, RIG, BALL)
    with pytest.raises(Unmeasurable):
        METHODS[name].solve({"left": one["left"]}, RIG, BALL)


@pytest.mark.parametrize("name", GENERAL)
def test_a_gap_in_one_view_is_bridged(name: str) -> None:
    """30 % of one view's edges are missing, as behind an occluder: within 1 mm."""
    nodes = curve("spatial2", SHAPES["spatial2"])
    views = views_of(nodes, RIG, BALL, noise_px=0.05)
    view = views["left"]
    n = len(view.rays)
    keep = np.r_[: int(0.4 * n), int(0.7 * n) : n]
    parts = {k: getattr(view, k)[keep] for k in ("edges_px", "edge_rays", "rays", "centreline_px")}
    found = METHODS[name].solve({**views, "left": replace(view, **parts)}, RIG, BALL)
    assert mean_off_mm(found, nodes.points) < 1.0


def _all_ways(n: int, m: int) -> list[list[tuple[int, int]]]:
    if n == 0 and m == 0:
        return [[(0, 0)]]
    before = [(n - a, m - b) for a, b in ((1, 0), (0, 1), (1, 1)) if n >= a and m >= b]
    return [[*way, (n, m)] for i, j in before for way in _all_ways(i, j)]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 4), st.integers(1, 4), st.integers(0, 10_000))
def test_the_way_is_the_cheapest_of_all(n: int, m: int, seed: int) -> None:
    cost = np.random.default_rng(seed).uniform(0, 1, (n, m))
    skip = 0.1

    def price(way: list[tuple[int, int]]) -> float:
        total = 2 * cost[0, 0]
        for (i, j), here in itertools.pairwise(way):
            total += 2 * cost[here] if here[0] > i and here[1] > j else cost[here] + skip
        return total

    for found in (cheapest_way, matching_kernels.cheapest_way, monotone_way):
        way = [(int(i), int(j)) for i, j in found(cost, skip)]
        assert way[0] == (0, 0) and way[-1] == (n - 1, m - 1)
        assert price(way) == pytest.approx(min(price(w) for w in _all_ways(n - 1, m - 1)))


def test_splines_through_points_of_a_helix() -> None:
    """24 points a turn: a cubic is (pi / 12)^4 / 384 of the radius off, 4e-4 mm, and some ten times it at its ends."""
    t = np.linspace(0, 2 * np.pi, 25)
    points = np.stack([30 * np.cos(t), 30 * np.sin(t), 10 * t], -1)
    length = 2 * np.pi * np.hypot(30, 10)
    fine = np.linspace(0, 2 * np.pi, 2001)
    true = np.stack([30 * np.cos(fine), 30 * np.sin(fine), 10 * fine], -1)
    # Smoothing may leave each point by its deviation, 0.02 mm, and more at the ends: three of it.
    for found, off_mm in ((interpolating(points), 4e-3), (smoothing(points, t, np.full(25, 0.02)), 0.06)):
        assert found.length_mm == pytest.approx(length, abs=2 * off_mm)
        np.testing.assert_allclose(np.linalg.norm(found.tangents, axis=1), 1.0)
        assert distance_to_polyline(found.points_mm, true).max() < off_mm
