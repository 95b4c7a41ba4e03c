"""Rivals without bands: as good as their geometry allows, refused where it allows nothing."""

import numpy as np
import pytest

from rival_scenes import (
    ARC,
    BALL,
    HELIX,
    POLYNOMIAL,
    RIG,
    S_SHAPE,
    SPATIAL,
    compared,
    outcome,
    photograph,
)
from tubesight.core import FramePair, Status
from tubesight.geometry.rig import Rig
from tubesight.methods.epipolar import depth_per_px
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Phantom, stage, straight
from tubesight.simulate.rigs import camera_pose

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
