"""The tip of the tube: which contour the end of a track has, and what the camera sees of it."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.camera import Camera
from tubesight.vision.ending import BORDER, FOUND, NO_END, Ending
from tubesight.vision.signal import Signal
from tubesight.vision.stages import Stages
from tubesight.vision.tip import FAINT, NECK_RAD, NOT_ROUND, RADIUS, ROUND_HALF_RAD, Contour
from tubesight.vision.view import TipView
from tubesight.vision.walker import Track

# The end of the tube is looked for within this many widths and ball diameters of the last pair of edges.
REACH_WIDTHS, REACH_BALLS = 3.0, 1.5
# A rounded end is believed when it is this near to half a circle across the way; else the way may be wrong, and a
# circle whose rms is this share of its own is taken instead.
ROUND_SURE_PX, _ROUND_BETTER = 0.5, 0.15
# A ball is believed when its contour is this near to a circle on so many of its lines; else it is looked for again with
# more care, and then beside the way (where a tube turns towards the camera at its end) at these angles.
BALL_SURE_PX, BALL_SURE_SEEN, _BALL_BETTER = 0.35, 0.85, 0.25
_TURNS_RAD = (-0.6, 0.6, -1.2, 1.2)
# Ratios of ball and tube that are tried where they are not known; each finds balls a quarter larger or smaller.
_RATIOS_TRIED = (1.0, 1.25, 1.6, 2.0)
# Largest accepted rms of the contour about the model: a contour that is something else is off by a pixel and more; a
# rounded end that points at the camera is no half circle.
RMS_MAX_PX, RMS_SHARE = 1.0, 0.05
_WHY_NOT = {
    NO_END: "the tube does not end",
    FAINT: "its contour does not stand out",
    NOT_ROUND: "too little of its contour is round",
}


def find_tip(
    stages: Stages, signal: Signal, camera: Camera, tube: Tube, track: Track, blur_px: float, outwards_px: float
) -> tuple[TipView, Ending, float]:
    """Find the tip beyond the last part of a track, whose edges lie so far outwards of where it has them.

    Returns
    -------
    tip, ending, radius_px
        The tip, where the tube ends, and the radius of the ball or rounded end (NaN for a flat one).

    Raises
    ------
    Unmeasurable
        If the end does not look like the tip that was announced.
    """
    found = []
    failure = Unmeasurable(Status.TIP_NOT_FOUND)
    track = track.widened(outwards_px)
    for ratio in _ball_ratios(tube):
        ending = stages.find_end(signal, track.middle_px, track.width_px, REACH_WIDTHS + REACH_BALLS * ratio)
        try:
            contour = _contour(stages, signal, tube, ending, ratio, blur_px, outwards_px)
            found.append((_tip_view(stages, camera, contour), ending, contour.radius_px))
        except Unmeasurable as caught:
            failure = caught
    if not found:
        raise failure
    return min(found, key=lambda each: each[0].rms_px)


def open_tip(ray: Array, px: Array) -> TipView:
    """Let a place of the centreline, ray (3,) and pixel (2,), stand for a tip that is not looked for."""
    return TipView(ray / np.linalg.norm(ray), px, float("nan"), np.empty((0, 2)), 0.0, 0.0)


def _ball_ratios(tube: Tube) -> tuple[float, ...]:
    """Diameter of ball over tube: known, or to be tried; the round end of an unknown tube may be a ball."""
    if tube.diameter_mm is None and tube.tip.shape != "flat":
        return _RATIOS_TRIED
    if tube.tip.shape == "ball" and tube.tip.diameter_mm is not None and tube.diameter_mm is not None:
        return (tube.tip.diameter_mm / tube.diameter_mm,)
    return (1.0,)


def _contour(
    stages: Stages, signal: Signal, tube: Tube, ending: Ending, ratio: float, blur_px: float, outwards_px: float
) -> Contour:
    """Contour of the shape that the tip has, or the reason why there is none."""
    if ending.outcome == BORDER:
        raise Unmeasurable(Status.TIP_AT_BORDER)
    if ending.outcome != FOUND:
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail=_WHY_NOT[ending.outcome])
    radius = ratio * ending.width_px / 2
    if tube.tip.shape == "flat":
        contour = stages.face(signal, ending.px, ending.heading, ending.width_px, blur_px, outwards_px)
    elif tube.tip.shape == "round" and ratio == 1.0:
        contour = _round_end(stages, signal, ending, radius, blur_px, outwards_px)
    else:
        contour = _carried_ball(stages, signal, ending, radius, ratio, blur_px, outwards_px)
    if contour.outcome == RADIUS:
        detail = f"radius {contour.radius_px:.1f} px where {radius:.1f} were expected"
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail=detail)
    if contour.outcome != FOUND:
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail=_WHY_NOT[contour.outcome])
    return contour


def _round_end(
    stages: Stages, signal: Signal, ending: Ending, radius: float, blur_px: float, outwards_px: float
) -> Contour:
    """Find a rounded end, or a ball of its size where the way at the end is not known."""
    centre = ending.px - radius * ending.heading
    contour = stages.round_end(signal, centre, ending.heading, radius, blur_px, outwards_px)
    if contour.outcome == FOUND and contour.rms_px < ROUND_SURE_PX:
        return contour
    # Near the end of a tube that turns towards the camera its way is not known; its round contour still is.
    ball = stages.ball(signal, centre, ending.heading, radius, ROUND_HALF_RAD, blur_px, outwards_px, False)
    better = ball.outcome == FOUND and not ball.rms_px > _ROUND_BETTER * contour.rms_px
    return ball if better or contour.outcome != FOUND else contour


def _carried_ball(
    stages: Stages, signal: Signal, ending: Ending, radius: float, ratio: float, blur_px: float, outwards_px: float
) -> Contour:
    """Find a ball that the tube carries; where it is not sure straight ahead, also to the sides of the tube's end."""
    heading = ending.heading
    half = float(np.pi - np.arcsin(min(1 / ratio, 1.0)) - NECK_RAD)
    centre = ending.px - radius * heading
    best = stages.ball(signal, centre, heading, radius, half, blur_px, outwards_px, False)
    if _sure(best):
        return best
    best = _better(best, stages.ball(signal, centre, heading, radius, half, blur_px, outwards_px, True))
    if _sure(best):
        return best
    neck = centre - radius * heading
    for turn in _TURNS_RAD:
        turned = _turned(heading, turn)
        ball = stages.ball(signal, neck + radius * turned, turned, radius, half, blur_px, outwards_px, False)
        if _sure(ball):
            return ball
        best = _better(best, ball)
    return best


def _turned(heading: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * heading[0] + s * heading[1], c * heading[1] - s * heading[0]])


def _sure(ball: Contour) -> bool:
    return ball.outcome == FOUND and ball.rms_px < BALL_SURE_PX and ball.seen > BALL_SURE_SEEN


def _better(one: Contour, other: Contour) -> Contour:
    """Take the second of two balls where it fits far better, or better while the first is seen on too few lines."""
    if other.outcome != FOUND or one.outcome != FOUND:
        return other if other.outcome == FOUND else one
    factor = 1.0 if one.seen <= BALL_SURE_SEEN else _BALL_BETTER
    return other if other.rms_px / other.seen**2 < factor * one.rms_px / one.seen**2 else one


def _tip_view(stages: Stages, camera: Camera, contour: Contour) -> TipView:
    """Turn a contour into rays: the axis of the cone around a ball, or the middle of the end."""
    points, px, rms, angle = contour.points_px, contour.middle_px, contour.rms_px, float("nan")
    limit = RMS_MAX_PX
    if contour.ball:
        axis, px, points, angle, rms = stages.tangent_cone(camera, points)
    else:
        ray = camera.unproject(px)
        axis = ray / np.linalg.norm(ray)
        if np.isfinite(contour.radius_px):
            limit += RMS_SHARE * contour.radius_px
            angle = float(np.arctan(contour.radius_px / camera.focal_px / np.linalg.norm(ray)))
    if not rms <= limit:
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail=f"its contour does not fit (rms {rms:.1f} px)")
    return TipView(axis, px, angle, points, rms, contour.doubt_px)
