"""The stages of seeing a tube: compiled ones where numba can work, else their readable twins.

Both have the same signatures and give the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from tubesight.core import Array, Image, Tube
from tubesight.core.kernels import COMPILED
from tubesight.geometry.camera import Camera
from tubesight.vision import ending, pairs, rays, silhouette, tip, walker
from tubesight.vision.signal import Signal
from tubesight.vision.view import View

Pair = tuple[Array, float] | None
Colours = tuple[Array, Array, Array, float]


@dataclass(frozen=True, slots=True)
class Stages:
    """Functions of one kind; see those of `READABLE` for what they do."""

    learn: Callable[[Image, Image | None, Array, Array, float], Colours]
    find_pair: Callable[[Signal, Array, Array, float, bool], Pair]
    walk: Callable[[Signal, Array, Array, float], walker.Track]
    walk_from_base: Callable[[Signal, Array, Array, float], walker.Track | None]
    measure: Callable[[Signal, walker.Track], tuple[Array, float, Array, float]]
    find_end: Callable[[Signal, Array, Array, float], ending.Ending]
    ball: Callable[[Signal, Array, Array, float, float, float, float, bool], tip.Contour]
    round_end: Callable[[Signal, Array, Array, float, float, float], tip.Contour]
    face: Callable[[Signal, Array, Array, float, float, float], tip.Contour]
    tangent_cone: Callable[[Camera, Array], tuple[Array, Array, Array, float, float]]
    tube_rays: Callable[
        [Camera, Array, Array, Array, float, float, Array], tuple[Array, Array, Array, Array, Array, Array]
    ]
    # All of them in one call, where each succeeds at its first attempt; None where there is none.
    see_from_base: Callable[[str, Image, Image | None, Camera, Tube, Array, Array, float], View | None] | None = None


READABLE = Stages(
    silhouette.learn,
    pairs.find_pair,
    walker.walk,
    walker.walk_from_base,
    walker.measure,
    ending.find_end,
    tip.ball,
    tip.round_end,
    tip.face,
    rays.tangent_cone,
    rays.tube_rays,
)


@lru_cache(maxsize=1)
def stages() -> Stages:
    """Compiled stages, or the readable ones where nothing can be compiled or kept."""
    if not COMPILED:
        return READABLE
    from tubesight.vision import compiled

    return Stages(
        compiled.learn,
        compiled.find_pair,
        compiled.walk,
        compiled.walk_from_base,
        compiled.measure,
        compiled.find_end,
        compiled.ball,
        compiled.round_end,
        compiled.face,
        compiled.tangent_cone,
        compiled.tube_rays,
        compiled.see_from_base,
    )
