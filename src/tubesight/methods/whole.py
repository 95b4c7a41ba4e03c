"""Which of several views of each picture show one curve."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product

from tubesight.core import Status, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import reprojection_rms_px
from tubesight.vision.view import View

Views = Mapping[str, View]

# Curves this near to the centrelines of their views are taken at once; farther ones where no other choice is nearer. On
# rendered photographs of loops and helices right choices left 0.05 to 0.35 px.
_NEAR_PX = 0.5
# Choices that are tried: the cheapest ones.
_TRIED = 9


def solve_any(
    options: Mapping[str, Sequence[tuple[float, View]]], rig: Rig, solve: Callable[[Views], Curve3D]
) -> tuple[Views, Curve3D]:
    """Solve for one view of each picture, the likeliest first, until a curve is found.

    Parameters
    ----------
    options
        By camera name: views of one picture, each with what speaks against it.

    Raises
    ------
    Unmeasurable
        If no choice gives a curve: the reason of the likeliest one.
    """
    choices = sorted(product(*options.values()), key=lambda each: sum(cost for cost, _ in each))
    found: list[tuple[float, Views, Curve3D]] = []
    failure: Unmeasurable | None = None
    for choice in choices[:_TRIED]:
        views = {name: view for name, (_, view) in zip(options, choice, strict=True)}
        try:
            curve = solve(views)
        except Unmeasurable as caught:
            failure = failure or caught
            continue
        found.append((reprojection_rms_px(curve, views, rig), views, curve))
        if found[-1][0] <= _NEAR_PX:
            break
    if not found:
        raise failure or Unmeasurable(Status.TUBE_NOT_FOUND)
    _, views, curve = min(found, key=lambda each: each[0])
    return views, curve
