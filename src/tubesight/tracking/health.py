"""Whether the cameras stand where they stood: watched by what the tube itself shows, frame by frame.

Three kinds of residuals are followed:

- ``base``: signed distance of one camera's silhouette from the fitted curve, near the clamp, px. The curve has to leave
  the clamp where the rig has it: a camera that moved shows there first, and in its own picture alone.
- ``side``: how far beside the projected clamp the centreline of one camera begins, px; coarser, but there also where no
  shape was measured.
- ``epipolar``: the signed distance of the tip from its epipolar line between two cameras, px (with x the pixel's ray:
  ``f x_a^T E x_b / sqrt(|(E x_b)_12|^2 + |(E^T x_a)_12|^2)``).

None changes much with the tube's shape, and a camera that moves changes at least one of them, but for the motions that
`blind_spots` computes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations
from typing import TypeVar

import numpy as np

from tubesight.core import Array, Status
from tubesight.geometry.camera import Camera
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.sensor import Reconstruction
from tubesight.vision.view import View

# A residual is averaged over so many frames by forgetting; its reference over so many from the start.
_MEMORY, _REFERENCE = 50, 60
# A change of a mean that is a motion, by residual. Of simulated tubes of all shapes at rest (0 to 86 degrees, 720p) the
# base stays within 0.08 px of its median, the side within 0.5 px, the tip within 0.16 px; 0.2 degrees of turn about any
# one axis of a camera change the base by 0.15 px or more, or the tip by 1.9 px.
_BASE_PX, _SIDE_PX, _EPIPOLAR_PX = 0.13, 1.0, 0.35
# Of what the tube's base is moved in a picture, the fit leaves this share as a residual: 0.28 to 0.34, measured.
_LEFT_BY_FIT = 0.28
# A residual that large at the start is a camera that moved since the calibration: careful rigs stay below 1 px.
_START_LIMIT_PX = 2.0
# One frame counts at most so much, so that a misread frame does not look like a motion.
_CLIP_PX = 1.5
# Share of the centreline at the base that is compared with the curve, and through which a parabola is laid; scans.
_NEAR, _PARABOLA, _SCANS_MIN = 1 / 6, 0.25, 6
# Points of the projected curve that its distance is taken from: one each pixel or two.
_CURVE_POINTS = 300
# What a monitor is asked to see.
_TURN_RAD, _SHIFT_MM = math.radians(0.2), 2.0
# One explanation is better than another where it misses the change of length by this share of the other's miss.
_BETTER = 0.5

_Key = TypeVar("_Key", str, tuple[str, str])


@dataclass(frozen=True, slots=True)
class Mean:
    """Running mean of one residual, its reference, and how many frames went in."""

    value: float = 0.0
    reference: float = 0.0
    count: int = 0

    def add(self, value: float, clip: float) -> Mean:
        """Take one more value into account; the first `_REFERENCE` make the reference."""
        if not math.isfinite(value):
            return self
        count = self.count + 1
        if self.count == 0:
            return Mean(value, value, 1)
        step = min(max(value - self.value, -clip), clip)
        mean = self.value + step / min(count, _MEMORY)
        return Mean(mean, self.reference + (value - self.reference) / count if count <= _REFERENCE else self.reference,
                    count)  # fmt: skip

    @property
    def change(self) -> float:
        """Change since the reference was taken; zero while it is."""
        return self.value - self.reference if self.count > _REFERENCE else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Health:
    """What is known of the rig.

    Attributes
    ----------
    base_px, side_px
        By camera; empty for a tube that is not clamped.
    epipolar_px
        By pair of cameras.
    length_mm
        Of the tube, which tells two cameras apart that explain an epipolar residual equally well.
    tip_mm
        (3,) where the tip was last.
    """

    base_px: Mapping[str, Mean] = field(default_factory=dict)
    side_px: Mapping[str, Mean] = field(default_factory=dict)
    epipolar_px: Mapping[tuple[str, str], Mean] = field(default_factory=dict)
    length_mm: Mean = field(default_factory=Mean)
    tip_mm: Array | None = None


def observe(health: Health, result: Reconstruction, rig: Rig, clamped: bool) -> Health:
    """Take the views of one pair into account, whether they gave a shape or not, unless of another device."""
    if result.status is Status.OTHER_DEVICE:
        return health
    side = dict(health.side_px)
    if clamped:
        for name, view in result.views.items():
            side[name] = side.get(name, Mean()).add(side_px(view, rig), _CLIP_PX)
    epipolar = dict(health.epipolar_px)
    for a, b in combinations(result.views, 2):
        value = epipolar_px(rig, a, b, result.views[a].tip.axis, result.views[b].tip.axis)
        epipolar[a, b] = epipolar.get((a, b), Mean()).add(value, _CLIP_PX)
    health = replace(health, side_px=side, epipolar_px=epipolar)
    if result and result.shape is not None and result.curve is not None:
        if clamped:
            base = dict(health.base_px)
            for name, view in result.views.items():
                base[name] = base.get(name, Mean()).add(base_px(view, result.curve, rig), _CLIP_PX)
            health = replace(health, base_px=base)
        length = health.length_mm.add(result.shape.length_mm, math.inf)
        health = replace(health, length_mm=length, tip_mm=result.shape.tip_mm)
    return health


def base_px(view: View, curve: Curve3D, rig: Rig) -> float:
    """Mean signed distance of a centreline from the projected curve near its base, px."""
    line = rig.project(view.camera, curve.at(np.linspace(0.0, curve.length_mm, _CURVE_POINTS)))
    seen = view.centreline_px[: max(int(len(view.centreline_px) * _NEAR), _SCANS_MIN)]
    if not np.isfinite(line).all():
        return math.nan
    nearest = np.linalg.norm(seen[:, None] - line[None, : _CURVE_POINTS // 2], axis=2).argmin(1)
    along = np.gradient(line, axis=0)[nearest]
    off = seen - line[nearest]
    across = (off[:, 1] * along[:, 0] - off[:, 0] * along[:, 1]) / np.linalg.norm(along, axis=1)
    return float(across.mean())


def side_px(view: View, rig: Rig) -> float:
    """Signed distance of the centreline from the projected origin of the clamp, across the clamp's axis, px."""
    base, along = _clamp(rig.cameras[view.camera], rig.camera_from_base[view.camera])
    count = max(int(len(view.centreline_px) * _PARABOLA), _SCANS_MIN)
    off = view.centreline_px[:count] - base
    if len(off) < _SCANS_MIN or not np.isfinite(off).all():
        return math.nan
    across = off @ np.array([-along[1], along[0]])
    # In units of the part's length: the parabola's value at zero is its first coefficient.
    powers = np.vander(off @ along / max(float(np.ptp(off @ along)), 1.0), 3, increasing=True)
    return float(np.linalg.lstsq(powers, across, rcond=None)[0][0])


@lru_cache(maxsize=64)
def _clamp(camera: Camera, camera_from_base: Pose) -> tuple[Array, Array]:
    """Where the clamp is in a picture, (2,) px, and the unit way (2,) of its axis."""
    base, ahead = camera.project(camera_from_base.apply(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])))
    return base, (ahead - base) / np.linalg.norm(ahead - base)


def epipolar_px(rig: Rig, a: str, b: str, ray_a: Array, ray_b: Array) -> float:
    """Signed distance of a point seen by two cameras from its epipolar lines, px, to first order."""
    x, y = ray_a / ray_a[2], ray_b / ray_b[2]
    essential = rig.essential(a, b)
    line_a, line_b = essential @ y, essential.T @ x
    scale = math.sqrt(line_a[0] ** 2 + line_a[1] ** 2 + line_b[0] ** 2 + line_b[1] ** 2)
    return float(x @ line_a) / scale * rig.cameras[a].focal_px if scale > 0 else math.nan


def verdict(health: Health, rig: Rig) -> str:
    """Say which camera moved, in a sentence; nothing while all residuals are where they were."""
    off = {name: mean.change / _LEFT_BY_FIT for name, mean in _beyond(health.base_px, _BASE_PX).items()}
    off |= {name: mean.change for name, mean in _beyond(health.side_px, _SIDE_PX).items()}
    lines = {pair: mean.change for pair, mean in _beyond(health.epipolar_px, _EPIPOLAR_PX).items()}
    if not off and not lines:
        return _at_start(health)
    if off and len(off) == len(health.side_px) > 1:
        return f"{_list(off)}: the tube's base is elsewhere in all pictures: the clamp moved, or several cameras did"
    if off:
        return f"{_list(off)} moved: the tube's base is about {_list_px(off)} beside where it was"
    common = [name for name in rig.names if all(name in pair for pair in lines)]
    if len(common) == 1:
        return f"{common[0]} moved: the tip is {_list_px(lines)} off its epipolar lines"
    named = _by_length(health, rig, lines)
    which = f"{named} probably moved" if named else f"{' or '.join(common or rig.names)} moved"
    return f"{which}: the tip is {_list_px(lines)} off its epipolar line"


def _beyond(means: Mapping[_Key, Mean], limit_px: float) -> dict[_Key, Mean]:
    return {key: mean for key, mean in means.items() if abs(mean.change) > limit_px}


def _at_start(health: Health) -> str:
    """Say which residuals were too large from the beginning."""
    done = [mean for mean in (*health.side_px.values(), *health.epipolar_px.values()) if mean.count >= _REFERENCE]
    worst = max((abs(mean.reference) for mean in done), default=0.0)
    if worst <= _START_LIMIT_PX:
        return ""
    return f"the rig was not as calibrated when this began ({worst:.1f} px); run `tubesight check`"


def _by_length(health: Health, rig: Rig, lines: Mapping[tuple[str, str], float]) -> str:
    """Name the camera whose motion explains the change of the tube's length too; nothing where none does clearly.

    A tip that is displaced across its epipolar line by e in one picture moves the triangulated tip, and with it the
    length. Two cameras that explain the same residual do so with opposite signs.
    """
    if len(lines) != 1 or health.tip_mm is None or health.length_mm.count <= _REFERENCE:
        return ""
    ((a, b), change) = next(iter(lines.items()))
    direction = health.tip_mm / np.linalg.norm(health.tip_mm)
    rays = {name: rig.cameras[name].unproject(rig.project(name, health.tip_mm)) for name in (a, b)}
    if not all(np.isfinite(ray).all() for ray in rays.values()):
        return ""
    misses = {}
    for name in (a, b):
        step = _epipolar_step(rig, a, b, rays, name)
        moved = rig.triangulate({n: (ray + (step if n == name else 0.0))[None] for n, ray in rays.items()})[0]
        longer = float((moved - health.tip_mm) @ direction) * change
        misses[name] = abs(longer - health.length_mm.change)
    best, other = sorted(misses, key=lambda name: misses[name])
    return best if misses[best] < _BETTER * misses[other] else ""


def _epipolar_step(rig: Rig, a: str, b: str, rays: Mapping[str, Array], name: str) -> Array:
    """Change (3,) of one camera's ray that changes the epipolar residual by one pixel, across its line."""
    essential = rig.essential(a, b)
    line = essential @ rays[b] if name == a else essential.T @ rays[a]
    across = np.array([line[0], line[1], 0.0]) / np.hypot(line[0], line[1])
    small = 1e-4
    off = {n: ray + (small * across if n == name else 0.0) for n, ray in rays.items()}
    per_unit = (epipolar_px(rig, a, b, off[a], off[b]) - epipolar_px(rig, a, b, rays[a], rays[b])) / small
    return np.asarray(across / per_unit)


def blind_spots(rig: Rig, tips_mm: Array, clamped: bool) -> tuple[str, ...]:
    """Say which motions of 0.2 degrees or 2 mm the residuals do not show, with the tip at one of these places (N, 3).

    Each camera is turned and shifted along its own axes in thought, and the change of every residual computed: of a
    place of the tip where it is least. A shift along the optical axis only magnifies the picture: the clamp moves along
    its own axis, and the tip along its epipolar line where it is as high in the picture as the other camera. (The
    tube's width changes too, by 0.2 px for 2 mm of 310, but with shape and light by up to 0.3 px.)
    """
    said = []
    for name in rig.names:
        for dof in range(6):
            turn, axis = dof < 3, "xyz"[dof % 3]
            amount = _TURN_RAD if turn else _SHIFT_MM
            moved = _moved(rig, name, dof, amount)
            shown = min(_shown(rig, moved, name, tip, clamped) for tip in np.atleast_2d(tips_mm))
            if shown <= 1.0:
                what = "turn about" if turn else "shift along"
                least = amount / shown if shown > 0 else math.inf
                size = f"{math.degrees(least):.1f} degrees" if turn else f"{least:.0f} mm"
                said.append(f"{name}: a {what} its {axis} axis below {size}")
    return tuple(said)


def _moved(rig: Rig, name: str, dof: int, amount: float) -> Rig:
    """Turn a camera about its own axis 0 to 2, or shift it along axis 3 to 5 less 3."""
    step = np.zeros(6)
    step[dof] = amount
    pose = Pose.from_rotvec(step[:3], step[3:]) @ rig.camera_from_base[name]
    return Rig(rig.cameras, {**rig.camera_from_base, name: pose}, rig.base_frame)


def _shown(rig: Rig, moved: Rig, name: str, tip_mm: Array, clamped: bool) -> float:
    """Largest change of a residual over its limit when the camera moves but the rig does not know."""
    shown = 0.0
    if clamped:
        base, along = _clamp(rig.cameras[name], rig.camera_from_base[name])
        off = moved.project(name, np.zeros(3)) - base
        shown = abs(float(off @ np.array([-along[1], along[0]]))) * max(_LEFT_BY_FIT / _BASE_PX, 1 / _SIDE_PX)
    for other in rig.names:
        if other != name:
            ray = moved.cameras[name].unproject(moved.project(name, tip_mm))
            value = epipolar_px(rig, name, other, ray, rig.cameras[other].unproject(rig.project(other, tip_mm)))
            shown = max(shown, abs(value) / _EPIPOLAR_PX)
    return shown


def _list(changes: Mapping[str, float]) -> str:
    return " and ".join(changes)


def _list_px(changes: Mapping[str, float] | Mapping[tuple[str, str], float]) -> str:
    return " and ".join(f"{abs(value):.1f} px" for value in changes.values())
