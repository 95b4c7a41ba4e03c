"""Variants of a simulated scene: what they add lies where it should, and nothing else changes."""

import numpy as np
import pytest

from tubesight.core import Tip, Tube
from tubesight.methods import METHODS
from tubesight.simulate import VARIANTS, Arc, Pieces, Scene, render_pair, rig_around, stage

RIG = rig_around(90.0, size_px=(640, 360))
BENT = Arc(np.radians(50), np.radians(30), 150.0)
BALL = Tube(12.0, Tip("ball", 16.0), clamped=True)
BARE = Scene(texture=0, gradient=0, vignetting=0, noise_levels=0, blur_px=0, shadow=0, specular=0)


def test_every_method_names_a_variant() -> None:
    assert {method.scene for method in METHODS.values()} <= set(VARIANTS)


def test_unknown_variant_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one of plain"):
        stage("stereo", RIG, BENT)


@pytest.mark.parametrize("variant", VARIANTS)
def test_tube_is_in_every_picture(variant: str) -> None:
    staged = stage(variant, RIG, BENT)
    points = BENT.at(np.linspace(0, BENT.length_mm, 20))
    for name in staged.rig.names:
        assert staged.rig.cameras[name].contains(staged.rig.project(name, points), 10.0).all()
        # A camera that is carried around the tube's middle sees it where the first one did.
        if "pair" in variant or "cameras" in variant:
            middle = BENT.at(np.array(75.0))
            first = RIG.project(RIG.names[0], middle)
            own = staged.rig.cameras[name].matrix[:2, 2] - RIG.cameras[RIG.names[0]].matrix[:2, 2]
            # The two cameras of a rig differ by half a percent in focal length.
            assert np.allclose(staged.rig.project(name, middle) - own, first, atol=0.01 * np.abs(first - 320).max())


def test_near_pair_stands_two_degrees_apart() -> None:
    rig = stage("near pair", RIG, BENT).rig
    middle = BENT.at(np.array(75.0))
    ways = [rig.centre_mm(name) - middle for name in rig.names]
    cosine = ways[0] @ ways[1] / np.linalg.norm(ways[0]) / np.linalg.norm(ways[1])
    # The base's z axis, about which they are turned, is not quite across their ways: less than two degrees, not more.
    assert 1.9 < np.degrees(np.arccos(cosine)) <= 2.0 + 1e-9


def test_bands_end_where_sections_do() -> None:
    robot = Pieces((Arc(0.5, 0.0, 50.0), Arc(0.4, 1.0, 70.0)))
    (a, b), (c, d) = stage("sections", RIG, robot).scene.bands_mm
    assert np.isclose((a + b) / 2, 50.0)
    assert (c, d) == (pytest.approx(117.0), 120.0)
    assert len(stage("grid", RIG, robot).scene.bands_mm) == 6
    assert len(stage("bands", RIG, robot).scene.bands_mm) == 10


def test_bands_are_painted_where_they_are_said_to_be() -> None:
    """Along the projected centreline a pixel is red inside of a band and white outside.

    The front of the tube, which the pixel shows, lies beside the centreline in the picture by less than the slope of
    the tube against the picture: here the band is straight ahead of the camera, at the base, where there is none.
    """
    scene = Scene(**{**{f: getattr(BARE, f) for f in ("texture", "gradient", "shadow")}, "noise_levels": 0.0})
    straight = Arc(0.0, 0.0, 150.0)
    painted = Scene(**{f: getattr(scene, f) for f in ("texture", "gradient", "shadow")}, bands_mm=((70.0, 80.0),))
    image = render_pair(RIG, straight, BALL, painted).images["left"].astype(float)
    for s, red in ((60.0, False), (68.0, False), (72.0, True), (78.0, True), (82.0, False), (100.0, False)):
        x, y = np.rint(RIG.project("left", straight.at(np.array(s)))).astype(int)
        assert (image[y, x, 2] > 2 * image[y, x, 0]) == red, s


def test_a_band_at_the_end_covers_the_ball() -> None:
    scene = stage("bands", RIG, BENT).scene
    image = render_pair(RIG, BENT, BALL, scene).images["right"].astype(float)
    tip = RIG.project("right", BENT.at(np.array(BENT.length_mm)))
    off = np.stack(np.meshgrid(np.arange(640), np.arange(360)), -1) - tip
    # The ball's radius is 8 mm, at 310 mm and a focal length of 370 px that is 9.5 px; blur and edge take two.
    ball = image[np.linalg.norm(off, axis=-1) < 7.0]
    assert (ball[:, 2] > ball[:, 0]).all()


def test_scene_without_bands_or_grid_is_unchanged() -> None:
    plain = render_pair(RIG, BENT, BALL, stage("plain", RIG, BENT, BARE).scene)
    grid = render_pair(RIG, BENT, BALL, Scene(**{f: getattr(BARE, f) for f in ("texture", "gradient")}, grid_mm=30.0))
    assert np.array_equal(plain.images["left"], render_pair(RIG, BENT, BALL, BARE).images["left"])
    assert not np.array_equal(plain.images["left"], grid.images["left"])


def test_bands_are_checked() -> None:
    with pytest.raises(ValueError, match="start < end"):
        Scene(bands_mm=((5.0, 4.0),))
