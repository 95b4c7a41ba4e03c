"""Methods that need bands: right where the bands are well seen, refused where they are not."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rival_scenes import (
    ARC,
    BALL,
    HELIX,
    POLYNOMIAL,
    RIG,
    S_SHAPE,
    SPATIAL,
    THIN,
    Outcome,
    compared,
    outcome,
    photograph,
)
from tubesight.core import FramePair, Status, Unmeasurable
from tubesight.geometry.arcs import end_of, joined
from tubesight.geometry.curve import Arc as FoundArc
from tubesight.geometry.pose import Pose
from tubesight.methods.bands import triangulate_bands
from tubesight.methods.markers_arcs import MarkersArcs, continued_arc
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Arc, Phantom
from tubesight.vision.bands import BandView

# A band's middle is known to about half a pixel where its front is bowed, a tip to a pixel where its end is 5 px wide;
# a pixel is 0.42 mm here.
_TIP_MM, _MEAN_MM = 0.5, 0.3


def right(result: Outcome) -> bool:
    return bool(result.found) and result.tip_mm < _TIP_MM and result.mean_mm < _MEAN_MM


@pytest.mark.parametrize("phantom", [ARC, S_SHAPE, SPATIAL, POLYNOMIAL, HELIX], ids=lambda p: p.kind)
def test_markers_follow_any_shape(phantom: Phantom) -> None:
    assert right(outcome("markers", phantom))


@pytest.mark.parametrize("name", ["markers", "markers_arcs", "arcs_planar"])
def test_thin_tubes_carry_bands_too(name: str) -> None:
    assert right(outcome(name, ARC, THIN))


@pytest.mark.parametrize("phantom", [ARC, S_SHAPE, SPATIAL], ids=lambda p: p.kind)
def test_arcs_of_sections(phantom: Phantom) -> None:
    assert right(outcome("markers_arcs", phantom))


def test_planar_arcs() -> None:
    assert right(outcome("arcs_planar", S_SHAPE))


def test_planar_arcs_from_one_view() -> None:
    """The left camera stands on +x: a robot that bends along y lies squarely before it."""
    square = Arc(np.radians(50), np.radians(90), 150.0)
    rig, pair = photograph(square, BALL, "sections")
    left = FramePair({"left": pair.images["left"]})
    assert right(compared(ShapeSensor(rig, BALL, "arcs_planar")(left), square))


def test_one_view_does_not_tell_the_plane() -> None:
    """Taken to bend across the line of sight, a robot that bends towards the camera is centimetres off."""
    rig, pair = photograph(Arc(np.radians(50), np.radians(45), 150.0), BALL, "sections")
    left = FramePair({"left": pair.images["left"]})
    result = compared(ShapeSensor(rig, BALL, "arcs_planar")(left), Arc(np.radians(50), np.radians(45), 150.0))
    # The tip's part towards the camera, 150 mm * (1 - cos 50) / 0.87 * sin 45 = 43 mm, is lost.
    assert result.tip_mm > 30.0


def test_planar_arcs_refuse_a_helix() -> None:
    assert outcome("arcs_planar", HELIX).found.status is Status.NOT_QUADRATIC


def test_sections_that_are_no_arcs_are_refused() -> None:
    rig, pair = photograph(S_SHAPE, BALL, "grid")
    views = ShapeSensor(rig, BALL, "markers_arcs")(pair).views
    with pytest.raises(Unmeasurable) as refused:
        MarkersArcs(marks=6)(views, rig, BALL)
    assert refused.value.status is Status.RESIDUAL_TOO_LARGE


def test_wrong_number_of_bands_is_refused() -> None:
    result = outcome("markers_arcs", ARC, variant="bands").found
    assert result.status is Status.VIEWS_DISAGREE
    assert "10 bands are not 3 to each section" in result.notes[0]


@pytest.mark.parametrize("name", ["markers", "markers_arcs", "arcs_planar"])
def test_a_tube_without_bands_is_refused(name: str) -> None:
    assert outcome(name, ARC, variant="plain").found.status is Status.TOO_FEW_POINTS


def test_gray_pictures_have_no_bands() -> None:
    rig, pair = photograph(ARC, BALL, "bands")
    gray = FramePair({name: image.mean(-1).astype(np.uint8) for name, image in pair.images.items()})
    assert ShapeSensor(rig, BALL, "markers")(gray).status is Status.BAD_IMAGE


def test_a_band_behind_the_tube_is_missed_not_mistaken() -> None:
    """Bent away from a camera, the tube's end hides a band against its ball: the counts differ."""
    away = Arc(np.radians(80), np.radians(200), 150.0)
    result = outcome("markers", away).found
    assert result.status is Status.VIEWS_DISAGREE
    assert "bands: 9 in left, 10 in right" in result.notes[0]


def test_bands_matched_to_their_neighbours_are_refused() -> None:
    rig, pair = photograph(ARC, BALL, "bands")
    views = dict(ShapeSensor(rig, BALL, "markers")(pair).views)
    left, right_ = views["left"], views["right"]
    assert isinstance(left, BandView)
    assert isinstance(right_, BandView)
    shifted = {
        "left": replace(left, bands_px=left.bands_px[1:]),
        "right": replace(right_, bands_px=right_.bands_px[:-1]),
    }
    with pytest.raises(Unmeasurable, match="miss each other"):
        triangulate_bands(shifted, rig)


def test_bands_are_where_the_simulator_painted_them() -> None:
    rig, pair = photograph(SPATIAL, BALL, "bands")
    views = ShapeSensor(rig, BALL, "markers")(pair).views
    # The middle of each band lies half a band (1.9 mm) before the tenth that it marks only at the tip.
    s = SPATIAL.length_mm * np.arange(1, 11) / 10
    for name, view in views.items():
        assert isinstance(view, BandView)
        assert view.tip_marked
        off = np.linalg.norm(view.bands_px - rig.project(name, SPATIAL.at(s)), axis=1)
        # Half a pixel where the tube leans most; the tip's ball is found to a tenth.
        assert off.max() < 0.6, name
        assert off[-1] < 0.2, name


def test_views_without_bands_are_a_wrong_call() -> None:
    rig, pair = photograph(ARC, BALL, "plain")
    with pytest.raises(ValueError, match="Bands"):
        triangulate_bands(ShapeSensor(rig, BALL, "cone_ray")(pair).views, rig)


@given(
    theta=st.floats(0.0, 3.0),
    phi=st.floats(-3.0, 3.0),
    length=st.floats(10.0, 200.0),
    turn=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
)
def test_continued_arc_is_the_arc_its_points_lie_on(
    theta: float, phi: float, length: float, turn: tuple[float, float, float]
) -> None:
    start = Pose.from_rotvec(np.array(turn), np.array([3.0, -2.0, 10.0]))
    curvature = theta / length * np.array([np.cos(phi), np.sin(phi)])
    true = FoundArc(curvature, length, start)
    found = continued_arc(start, true.at(length * np.array([1 / 3, 2 / 3, 1.0])))
    s = np.linspace(0, length, 7)
    # Rounding of 1e-16 of 200 mm, over the least share of a turn that three points have on a half circle.
    assert np.allclose(found.at(s * found.length_mm / length), true.at(s), atol=1e-6)


def test_arcs_join_without_a_kink() -> None:
    first = FoundArc(np.array([0.01, 0.0]), 50.0)
    second = FoundArc(np.array([0.0, -0.02]), 40.0, end_of(first))
    curve = joined([first, second])
    assert curve.length_mm == 90.0
    s = np.linspace(0, 40, 9)
    # A cubic Hermite piece of 1 / 24 of 0.8 rad is h^4 kappa^3 / 384 off: 2e-7 mm.
    assert np.allclose(curve.at(50.0 + s), second.at(s), atol=1e-6)
    assert np.allclose(curve.tangent([50.0])[0], first.tangent([50.0])[0], atol=1e-6)


def test_rig_is_the_one_the_variants_start_from() -> None:
    assert photograph(ARC, BALL, "bands")[0] is RIG


@pytest.mark.parametrize("phi", [150, 330])
def test_a_band_beside_a_ball_of_its_colour_is_where_it_was_painted(phi: int) -> None:
    """Bent towards a camera and away from it: the last band lies beyond the last scans, near the ball or against it."""
    bent = Arc(np.radians(40), np.radians(phi), 160.0)
    rig, pair = photograph(bent, BALL, "bands")
    for name, view in ShapeSensor(rig, BALL, "markers")(pair).views.items():
        assert isinstance(view, BandView)
        expected = rig.project(name, bent.at(bent.length_mm * np.arange(1, 11) / 10))
        assert len(view.bands_px) == len(expected)
        # As above; a band seen at its most slanting has a pixel of its own front between its edges.
        assert np.linalg.norm(view.bands_px - expected, axis=1).max() < 1.0, name
