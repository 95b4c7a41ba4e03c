"""What other methods need to see of the same tube: more cameras, cameras side by side, bands, a grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType

import numpy as np

from tubesight.core import Array
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate.phantom import Phantom, Pieces, Placed
from tubesight.simulate.scene import Scene

# Bands all along a tube: ten, each a fortieth of its length (4 mm on 160 mm), as on the robots that carry them.
_BANDS, _BAND_SHARE = 10, 1 / 40
# Sections of a tube that is not made of pieces, and marks on each where more than its end is marked.
_SECTIONS, _MARKS = 3, 3
# Spacing of the grid's lines on the wall.
_GRID_MM = 20.0
# Angle between cameras that see the same thing side by side.
_NEAR_RAD = np.radians(2.0)
# A low pair and every other camera of a ring stand so much lower and look up: off the plane across the tube's middle,
# and so that no two cameras of a ring see the same silhouette.
_LOWER_RAD = np.radians(20.0)


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """A rig and a scene to photograph a phantom with."""

    rig: Rig
    scene: Scene


def stage(variant: str, rig: Rig, phantom: Phantom, scene: Scene | None = None) -> Stage:
    """Give a rig and a scene what a method asks for (`Method.scene`).

    Parameters
    ----------
    variant
        ``plain``: as it is. ``bands``: ten bands along the tube, the last at its tip. ``sections``: a band at the end
        of each section. ``grid``: three bands on each section, and a grid on the wall. ``near pair``: two cameras two
        degrees apart. ``low pair``: the first two cameras, lowered by 20 degrees to look up. ``four cameras``,
        ``eight cameras``: on half a circle about the tube, all alike.

    Raises
    ------
    ValueError
        If there is no such variant.
    """
    if variant not in VARIANTS:
        raise ValueError(f"variant: expected one of {', '.join(VARIANTS)}, got {variant!r}")
    return VARIANTS[variant](rig, phantom, scene or Scene())


def _bands(rig: Rig, phantom: Phantom, scene: Scene) -> Stage:
    length = phantom.length_mm
    return Stage(rig, _painted(scene, length * np.arange(1, _BANDS + 1) / _BANDS, length))


def _sections(rig: Rig, phantom: Phantom, scene: Scene) -> Stage:
    return Stage(rig, _painted(scene, section_ends(phantom), phantom.length_mm))


def _grid(rig: Rig, phantom: Phantom, scene: Scene) -> Stage:
    ends = np.concatenate([[0.0], section_ends(phantom)])
    marks = np.concatenate([a + (b - a) * np.arange(1, _MARKS + 1) / _MARKS for a, b in pairwise(ends)])
    return Stage(rig, replace(_painted(scene, marks, phantom.length_mm), grid_mm=_GRID_MM))


def section_ends(phantom: Phantom) -> Array:
    """Arc lengths where the sections of a phantom end: its pieces, or three of equal length."""
    inner = phantom.phantom if isinstance(phantom, Placed) else phantom
    if isinstance(inner, Pieces):
        return np.cumsum([arc.length_mm for arc in inner.arcs])
    return inner.length_mm * np.arange(1, _SECTIONS + 1) / _SECTIONS


def _painted(scene: Scene, middle_mm: Array, length_mm: float) -> Scene:
    """Paint a band about each arc length; the last one ends with the tube."""
    half = _BAND_SHARE * length_mm / 2
    bands = [(float(s - half), float(s + half)) for s in middle_mm[:-1]]
    return replace(scene, bands_mm=(*bands, (length_mm - 2 * half, length_mm)))


def _near_pair(rig: Rig, phantom: Phantom, scene: Scene) -> Stage:
    one, other = rig.names[:2] if len(rig.names) > 1 else (rig.names[0], f"{rig.names[0]}_2")
    first = rig.camera_from_base[one]
    target = phantom.at(np.array(phantom.length_mm / 2))
    cameras = {one: rig.cameras[one], other: rig.cameras.get(other, rig.cameras[one])}
    return Stage(Rig(cameras, {one: first, other: _moved(first, target, _NEAR_RAD, 0.0)}, rig.base_frame), scene)


def _low_pair(rig: Rig, phantom: Phantom, scene: Scene) -> Stage:
    target = phantom.at(np.array(phantom.length_mm / 2))
    poses = {name: _moved(rig.camera_from_base[name], target, 0.0, _LOWER_RAD) for name in rig.names[:2]}
    return Stage(Rig({name: rig.cameras[name] for name in poses}, poses, rig.base_frame), scene)


def _ring(count: int) -> Callable[[Rig, Phantom, Scene], Stage]:
    def ring(rig: Rig, phantom: Phantom, scene: Scene) -> Stage:
        return Stage(_ring_of(rig, phantom, count), scene)

    return ring


def _ring_of(rig: Rig, phantom: Phantom, count: int) -> Rig:
    first = rig.names[0]
    pose, target = rig.camera_from_base[first], phantom.at(np.array(phantom.length_mm / 2))
    names: Sequence[str] = [f"camera{k + 1}" for k in range(count)]
    poses = {n: _moved(pose, target, np.pi * k / count, _LOWER_RAD * (k % 2)) for k, n in enumerate(names)}
    return Rig(dict.fromkeys(names, rig.cameras[first]), poses, rig.base_frame)


def _moved(camera_from_base: Pose, target_mm: Array, turn_rad: float, lower_rad: float) -> Pose:
    """Carry a camera around a target: lowered about its own x axis, then turned about the base's z axis."""
    sideways = camera_from_base.rotation[0]
    turned = Pose.from_rotvec(np.array([0.0, 0.0, turn_rad]), np.zeros(3))
    carried = turned @ Pose.from_rotvec(lower_rad * sideways, np.zeros(3))
    about = Pose(carried.rotation, target_mm - carried.rotation @ target_mm)
    return camera_from_base @ about.inverse()


VARIANTS: Mapping[str, Callable[[Rig, Phantom, Scene], Stage]] = MappingProxyType(
    {
        "plain": lambda rig, phantom, scene: Stage(rig, scene),
        "bands": _bands,
        "sections": _sections,
        "grid": _grid,
        "near pair": _near_pair,
        "low pair": _low_pair,
        "four cameras": _ring(4),
        "eight cameras": _ring(8),
    }
)
