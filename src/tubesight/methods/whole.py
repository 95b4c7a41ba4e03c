"""Views from whole silhouettes, of a tube that no walk follows: which of them show one curve, and all of the tube."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product

import numpy as np

from tubesight.core import Image, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import reprojection_rms_px
from tubesight.vision.rest import leaves_out
from tubesight.vision.see import Start
from tubesight.vision.signal import Signal
from tubesight.vision.silhouette import signal_of
from tubesight.vision.stages import stages
from tubesight.vision.view import View
from tubesight.vision.whole import see_whole

Views = Mapping[str, View]

# Curves this near to the centrelines of their views are taken at once, farther ones where no other choice is nearer,
# and those not if they leave anything out. On rendered loops and helices right choices left 0.05 to 0.4 px.
_NEAR_PX = 0.5
# Choices that are tried: the cheapest ones.
_TRIED = 9
# Places of a curve by which its image is told.
_POINTS = 201


def signals_of(
    images: Mapping[str, Image], backgrounds: Mapping[str, Image], starts: Mapping[str, Start]
) -> dict[str, list[Signal]]:
    """Signals of each picture: by its own colours, and by those of the others, for where it passes its own base."""
    run = stages()
    colours = {
        name: run.learn(image, backgrounds.get(name), start.px, start.way, start.width_px)
        for name, image in images.items()
        if (start := starts.get(name))
    }
    signals: dict[str, list[Signal]] = {}
    for name, image in images.items():
        signals[name] = []
        for other in sorted(colours, key=lambda other: other != name):
            try:
                signals[name].append(signal_of(image, backgrounds.get(name), colours[other]))
            except Unmeasurable as caught:
                failure = caught
        if not signals[name]:
            raise failure
    return signals


def see_any(
    signals: Mapping[str, Sequence[Signal]], rig: Rig, tube: Tube, starts: Mapping[str, Start]
) -> dict[str, list[tuple[float, View]]]:
    """See each picture in all ways that may be right, each with what speaks against it (`vision.whole.see_whole`).

    Raises
    ------
    Unmeasurable
        If there is none of a picture.
    """
    options: dict[str, list[tuple[float, View]]] = {}
    for name, known in signals.items():
        failure: Unmeasurable | None = None
        for signal in known:
            try:
                options[name] = see_whole(name, signal, rig.cameras[name], tube, starts[name])
                break
            except Unmeasurable as caught:
                failure = failure or caught
        if name not in options:
            raise failure or Unmeasurable(Status.TUBE_NOT_FOUND)
    return options


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
        views: Views = {name: view for name, (_, view) in zip(options, choice, strict=True)}
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
    _, chosen, curve = min(found, key=lambda each: each[0])
    return chosen, curve


def believe(curve: Curve3D, views: Views, rig: Rig, signal_of_view: Callable[[str], Signal]) -> None:
    """Refuse a curve that leaves out a part of the tube in all pictures, or in any one where it is off its views.

    Parameters
    ----------
    signal_of_view
        Signal of a camera's picture.

    Raises
    ------
    Unmeasurable
        If something as wide as the tube leaves it there.
    """
    points = curve.at(np.linspace(0.0, curve.length_mm, _POINTS))
    left_out = (leaves_out(view, rig.project(name, points), signal_of_view(name)) for name, view in views.items())
    near = reprojection_rms_px(curve, views, rig) <= _NEAR_PX
    if all(left_out) if near else any(left_out):
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail="a strand as wide as the tube is left out")
