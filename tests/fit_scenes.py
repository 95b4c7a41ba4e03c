"""Exact silhouettes of tubes: views whose edges are tangent to the tube, without pictures."""

import numpy as np

from tubesight.core import Tube
from tubesight.geometry.families import FAMILIES, Nodes, nodes_of
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.vision.view import TipView, View


def curve(family: str, parameters: list[float], start: Pose | None = None) -> Nodes:
    """Nodes of a curve of a family, its base at the origin along +z unless told otherwise."""
    f = FAMILIES[family]
    return nodes_of(f, np.append(parameters, np.zeros(4)), start or Pose.identity())


# How far measurements of a row lie apart where there is shading: on photographs, from which all of it is expected.
DOUBT_PX = 0.01


def views_of(
    nodes: Nodes,
    rig: Rig,
    tube: Tube,
    noise_px: float = 0.0,
    rng: np.random.Generator | None = None,
    shading_px: float = 0.0,
) -> dict[str, View]:
    """Views of both cameras: edges of the tube up to its tip and contour of the tip.

    White noise on all of them; `shading_px` moves each row of edges as a whole and tilts it, and moves the contour.
    Where it does, measurements of a row disagree by `DOUBT_PX`.
    """
    rng = rng or np.random.default_rng(0)
    return {name: _view(nodes, rig, name, tube, noise_px, rng, shading_px) for name in rig.names}


def _view(
    nodes: Nodes, rig: Rig, name: str, tube: Tube, noise_px: float, rng: np.random.Generator, shading_px: float
) -> View:
    assert tube.diameter_mm is not None
    radius = tube.diameter_mm / 2
    ball = (tube.tip.diameter_mm or tube.diameter_mm) / 2
    camera, pose = rig.cameras[name], rig.camera_from_base[name]
    centre = rig.centre_mm(name)
    on_tube = nodes.s_mm < nodes.s_mm[-1] - np.sqrt(max(ball**2 - radius**2, 0.0)) - 0.5
    points, tangents = nodes.points[on_tube], nodes.tangents[on_tube]
    towards = centre - points
    towards = towards - (towards * tangents).sum(1, keepdims=True) * tangents
    away = np.linalg.norm(towards, axis=1, keepdims=True)
    # A tangent plane through the camera touches the tube where its unit normal n has n . (centre - point) = radius.
    cos = radius / away
    side = np.cross(tangents, towards / away)
    edges = np.stack(
        [points + radius * (cos * towards / away + sign * np.sqrt(1 - cos**2) * side) for sign in (1, -1)], 1
    )
    noise = rng.normal(size=(len(points), 2, 2)) * noise_px
    exact = camera.project(pose.apply(edges))
    across = exact[:, 0] - exact[:, 1]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    lobes = shading_px * (rng.normal(size=2) + np.linspace(-1, 1, len(points))[:, None] * rng.normal(size=2))
    edges_px = exact + noise + np.stack([across, -across], 1) * lobes[..., None]
    rays = camera.unproject(edges_px)
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    middle = unit.sum(1) / unit.sum(1)[:, 2:]
    base = pose.apply(nodes.points[0])
    sd = max(noise_px, 0.02)
    return View(
        name,
        edges_px,
        unit,
        middle,
        camera.project(middle),
        base / base[2],
        _tip(nodes, rig, name, tube, ball, noise_px, rng, shading_px),
        np.full(2, sd),
        np.full(2, DOUBT_PX if shading_px else 0.0),
        0.8,
        "made for a test",
    )


def _tip(
    nodes: Nodes,
    rig: Rig,
    name: str,
    tube: Tube,
    ball: float,
    noise_px: float,
    rng: np.random.Generator,
    shading_px: float,
) -> TipView:
    camera, pose = rig.cameras[name], rig.camera_from_base[name]
    tip, forward = pose.apply(nodes.points[-1]), pose.rotate(nodes.tangents[-1])
    axis = tip / np.linalg.norm(tip)
    if tube.tip.shape == "flat":
        # The rim of the face, of which the forward half is seen.
        one = np.cross(forward, axis) / np.linalg.norm(np.cross(forward, axis))
        angle = np.linspace(0.0, 2 * np.pi, 240)[:, None]
        rim = camera.project(tip + ball * (np.cos(angle) * one + np.sin(angle) * np.cross(forward, one)))
        px, ahead = camera.project(np.stack([tip, tip + forward]))
        contour, half = rim[(rim - px) @ (ahead - px) > 0], np.nan
    else:
        half = float(np.arcsin(ball / np.linalg.norm(tip)))
        one = np.cross(axis, forward) / np.linalg.norm(np.cross(axis, forward))
        angle = np.linspace(-1.4, 1.4, 40)[:, None]
        around = np.cos(angle) * np.cross(one, axis) + np.sin(angle) * one
        contour = camera.project(np.cos(half) * axis + np.sin(half) * around)
    contour = contour + rng.normal(size=contour.shape) * noise_px + rng.normal(size=2) * shading_px
    return TipView(axis, camera.project(tip), half, contour, max(noise_px, 0.02), DOUBT_PX if shading_px else 0.0)
