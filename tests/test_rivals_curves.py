"""Rivals without bands: as good as their geometry allows, refused where it allows nothing."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from rival_scenes import (
    ARC,
    BALL,
    HELIX,
    HOOK,
    MM_PER_PX,
    POLYNOMIAL,
    RIG,
    S_SHAPE,
    SPATIAL,
    THIN,
    compared,
    outcome,
    photograph,
)
from tubesight.core import FramePair, Status, Tube
from tubesight.geometry.polyline import place_along
from tubesight.geometry.rig import Rig
from tubesight.methods import METHODS, affine_shape, carving, nurbs, symmetric
from tubesight.methods.epipolar import depth_per_px
from tubesight.methods.regions import regions, rough_way
from tubesight.methods.rivals import RIVALS
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Arc, Phantom, stage, straight
from tubesight.simulate.rigs import camera_pose
from tubesight.vision.region import see_region

# A centreline is known to this, px: shading moves both of its edges.
_CENTRELINE_PX = 0.15


@pytest.mark.parametrize("phantom", [ARC, POLYNOMIAL, HELIX, S_SHAPE, SPATIAL], ids=lambda p: p.kind)
def test_near_views_are_as_good_as_their_angle_allows(phantom: Phantom) -> None:
    """Two degrees apart a pixel is 12 mm of depth: the bound is that times a centreline's deviation, 1.8 mm."""
    result = outcome("epipolar", phantom)
    rig = stage("near pair", RIG, phantom).rig
    per_px = depth_per_px(rig, "left", "right", phantom.at(np.array(75.0)))
    assert 10.0 < per_px < 13.0
    assert result.mean_mm < per_px * _CENTRELINE_PX
    # The tip is a place of its own in each picture, known to a third of a pixel and no better.
    assert result.tip_mm < per_px / 3


@pytest.mark.parametrize("phantom", [ARC, POLYNOMIAL], ids=lambda p: p.kind)
def test_epipolar_matching_works_at_a_right_angle_too(phantom: Phantom) -> None:
    result = outcome("epipolar", phantom, variant="plain")
    # A pixel is 0.3 mm there; the centreline's deviation and smoothing take half of one.
    assert result.mean_mm < 0.15
    assert result.tip_mm < 0.2


def test_cameras_above_each_other_see_a_hanging_tube_along_their_epipolar_lines() -> None:
    lower = camera_pose(0.0, 310.0, (0.0, 0.0, 80.0), elevation_deg=-4.0)
    above = Rig(RIG.cameras, {"left": RIG.camera_from_base["left"], "right": lower})
    result = outcome("epipolar", straight(150.0), variant="plain", rig=above)
    assert result.found.status is Status.NEAR_DEGENERATE
    assert "along the tube" in result.found.notes[0]


def test_one_view_is_not_enough() -> None:
    rig, pair = photograph(ARC, BALL, "near pair")
    alone = FramePair({"left": pair.images["left"]})
    assert compared(ShapeSensor(rig, BALL, "epipolar")(alone), ARC).found.status is Status.TOO_FEW_POINTS


@pytest.mark.parametrize(
    ("phantom", "tube", "limit_px"),
    [(ARC, BALL, 0.1), (SPATIAL, BALL, 0.1), (ARC, THIN, 0.15)],
    ids=["arc", "spatial", "thin"],
)
def test_nurbs_lies_on_the_edges(phantom: Phantom, tube: Tube, limit_px: float) -> None:
    """Edges are known to a tenth of a pixel; light from one side moves both of a tube of 10 px by some hundredths."""
    assert outcome("nurbs", phantom, tube).mean_mm < limit_px * MM_PER_PX


def test_edges_depend_less_on_the_light_of_the_tube() -> None:
    """What shading changes, by what an edge changes: a sixth less than with a plain difference of white and blue."""
    tube, cloth = np.array([0.7, 0.75, 0.8]), np.array([0.35, 0.1, 0.05])
    weights, difference = nurbs._edge_of(tube, cloth), tube - cloth
    assert weights @ difference > 0
    assert abs(weights @ tube) / (weights @ difference) < 5 / 6 * (difference @ tube) / (difference @ difference)
    assert nurbs._edge_of(tube[:1], cloth[:1]) > 0 > nurbs._edge_of(cloth[:1], tube[:1])


def test_a_finer_knot_vector_holds_the_same_curve() -> None:
    rng = np.random.default_rng(4)
    spline = nurbs._Spline(np.repeat([0.0, 1.0], 4), rng.normal(size=(4, 3)))
    finer = nurbs._with_knot(spline, 0.0, 1.0)
    u = np.linspace(0, 1, 30)
    assert len(finer.control) == 5
    assert np.allclose(finer.basis(u) @ finer.control, spline.basis(u) @ spline.control, atol=1e-12)


@pytest.mark.parametrize("phantom", [ARC, S_SHAPE, HELIX], ids=lambda p: p.kind)
def test_carving_with_eight_cameras(phantom: Phantom) -> None:
    """A voxel is 1.2 mm; the hull's end is known to half of one and half a pixel of the silhouettes."""
    result = outcome("carving", phantom)
    assert result.tip_mm < 1.0
    assert result.mean_mm < 0.5


def test_two_silhouettes_carve_a_fatter_hull() -> None:
    """The hull of two views has the section of a square, not of a circle: 4 / pi, more where the tube is oblique."""
    volumes = []
    for variant in ("plain", "eight cameras"):
        rig, pair = photograph(ARC, BALL, variant)
        views = regions(ShapeSensor(rig, BALL, "carving")(pair).views)
        kept, sure = carving.carve(views, rig, rough_way(views, rig, 9), 12.0)
        volumes.append(int(sure.sum()))
        assert len(kept) >= volumes[-1]
    assert volumes[0] / volumes[1] > 4 / np.pi


@pytest.mark.parametrize("name", ["carving", "som", "nurbs", "affine_shape"])
def test_views_that_do_not_belong_together_are_refused(name: str) -> None:
    """One of four pictures is of another tube: no curve lies in all of them."""
    rig, pair = photograph(ARC, BALL, "four cameras")
    _, other = photograph(S_SHAPE, BALL, "four cameras")
    mixed = FramePair({**pair.images, "camera3": other.images["camera3"]})
    assert not ShapeSensor(rig, BALL, name)(mixed)


@pytest.mark.parametrize("phantom", [ARC, S_SHAPE, HELIX], ids=lambda p: p.kind)
def test_map_lies_in_the_silhouettes_but_its_ends_shrink(phantom: Phantom) -> None:
    result = outcome("som", phantom)
    # Half a millimetre where neurons 5 mm apart are drawn about, and millimetres at the ends.
    assert result.mean_mm < 2.0
    assert result.found.curve is not None
    assert result.found.curve.length_mm < phantom.length_mm
    assert result.tip_mm > 1.0


@pytest.mark.parametrize("phantom", [ARC, S_SHAPE, HELIX], ids=lambda p: p.kind)
def test_affine_shape_finds_corresponding_places(phantom: Phantom) -> None:
    result = outcome("affine_shape", phantom)
    assert result.mean_mm < 0.3
    assert result.tip_mm < 0.3


def test_affine_shape_needs_three_views() -> None:
    assert outcome("affine_shape", ARC, variant="plain").found.status is Status.TOO_FEW_POINTS


# A planar curve has rank three, which fixes its correspondence; a curve in space has rank four, of which twelve rows
# over a few sines leave more open.
@pytest.mark.parametrize(("phantom", "share_left"), [(ARC, 0.05), (POLYNOMIAL, 0.05), (SPATIAL, 0.5)])
def test_correspondence_needs_no_cameras(phantom: Phantom, share_left: float) -> None:
    """Parallel projections of a robot, cut into equal shares of their own lengths, and slid to their rank."""
    s = np.linspace(0.0, phantom.length_mm, 161)
    shares, curves = [], []
    for azimuth, lift in ((0.0, 0.1), (0.8, -0.3), (1.6, 0.2), (2.4, -0.2)):
        sideways = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        ahead = np.array([np.cos(azimuth) * np.cos(lift), np.sin(azimuth) * np.cos(lift), np.sin(lift)])
        image = phantom.at(s) @ np.stack([sideways, np.cross(ahead, sideways)], -1)
        share = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(image, axis=0), axis=1))])
        shares.append(share / share[-1])
        curves.append(affine_shape._ImageCurve(CubicSpline(shares[-1], np.column_stack([image, np.ones(len(s))]))))
    places = affine_shape.correspond(curves)
    first = np.interp(places[0], shares[0], s)
    pairs = list(zip(places[1:], shares[1:], strict=True))
    before = np.mean([np.abs(np.interp(places[0], share, s) - first) for _, share in pairs])
    after = np.mean([np.abs(np.interp(place, share, s) - first) for place, share in pairs])
    assert after < share_left * before


@pytest.mark.parametrize("azimuth", [30.0, 100.0])
def test_mirror_plane_of_an_arc(azimuth: float) -> None:
    bent = Arc(np.radians(40), np.radians(azimuth), 150.0)
    result = outcome("symmetric", bent)
    # Pairs are matched to half a pixel near the apex, with a camera and its image 100 mm apart: 1 mm.
    assert result.mean_mm < 0.5
    assert result.tip_mm < 1.0


@pytest.mark.parametrize("phantom", [POLYNOMIAL, S_SHAPE, SPATIAL, HOOK], ids=["polynomial", "S", "spatial", "hook"])
def test_curves_without_symmetry_are_refused(phantom: Phantom) -> None:
    result = outcome("symmetric", phantom).found
    assert result.status is Status.RESIDUAL_TOO_LARGE
    assert "no mirror plane" in result.notes[0]


def test_mirrored_curve_is_exact() -> None:
    """Rays of an exact arc and its exact mirror plane give the arc."""
    arc = Arc(np.radians(60), 0.0, 120.0)
    s = np.linspace(0, 120.0, 4001)
    points = arc.at(s)
    chord = points[-1] / np.linalg.norm(points[-1])
    centre = np.array([50.0, 300.0, 200.0])
    rays = (points - centre) / np.linalg.norm(points - centre, axis=1, keepdims=True)
    found = symmetric.mirrored_curve(symmetric._Sight(centre, rays, "a"), chord, float(chord @ points[-1]) / 2)
    assert found is not None
    _, off = place_along(points, found)
    # Rays are interpolated between points 0.03 mm apart, near the apex where places move as the root of the level.
    assert off.max() < 1e-3
    # A camera in the mirror plane is its own mirror image.
    within = centre - (chord @ centre - chord @ points[-1] / 2) * chord
    rays = (points - within) / np.linalg.norm(points - within, axis=1, keepdims=True)
    flat = symmetric._Sight(within, rays, "a")
    assert symmetric.mirrored_curve(flat, chord, float(chord @ points[-1]) / 2) is None


def test_a_straight_tube_has_no_bend_to_be_mirrored() -> None:
    assert outcome("symmetric", straight(150.0)).found.status is Status.NEAR_DEGENERATE


def test_every_rival_says_what_it_is() -> None:
    for name, method in RIVALS.items():
        assert method.name == name
        assert method.citation.startswith("after ")
        assert set(method.traits) == set(METHODS["cone_ray"].traits)


@pytest.mark.parametrize("name", RIVALS)
@pytest.mark.parametrize("level", [0, 128, 255])
def test_empty_pictures_give_a_status(name: str, level: int) -> None:
    pair = FramePair({camera: np.full((720, 1280, 3), level, np.uint8) for camera in RIG.names})
    assert ShapeSensor(RIG, BALL, name)(pair).status in (Status.TUBE_NOT_FOUND, Status.TOO_FEW_POINTS)


@pytest.mark.parametrize("name", [n for n, m in RIVALS.items() if m.see is see_region])
def test_views_without_signal_are_a_wrong_call(name: str) -> None:
    rig, pair = photograph(ARC, BALL, "plain")
    with pytest.raises(ValueError, match="see_region"):
        RIVALS[name].solve(ShapeSensor(rig, BALL, "cone_ray")(pair).views, rig, BALL)
