"""What choosing the family of a curve costs and gives: prints the table of docs/theory.md.

Run in the folder of the project: ``python docs/families.py`` (a minute). Simulated photographs (1920 x 1080, cameras
90 degrees apart at 0.31 m) of a tube of 6 mm are fitted as `silhouette` does, then with each family alone. A fixed
family starts where the choice starts, from the circle to the tip, and from centrelines matched between the views where
that leads nowhere.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from unittest import mock

import numpy as np

from tubesight.apps.evaluate import distance_to_polyline
from tubesight.core import Array, Status, Tip, Tube, Unmeasurable
from tubesight.geometry.arcs import clamped_arc
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.families import FAMILIES, INTERVALS, Family, spatial_like, turns_of
from tubesight.geometry.rig import Rig
from tubesight.methods import METHODS, silhouette
from tubesight.methods.choice import AnyShape
from tubesight.methods.fit import Fit, fit_family
from tubesight.methods.general import placed
from tubesight.methods.rays import Problem
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Arc, EllipseArc, Helix, Phantom, Pieces, render_pair, rig_around
from tubesight.vision.view import View

TUBE = Tube(6.0, Tip("ball", 8.0), clamped=True)
RUNS = 7
# Of two starts the second counts only where it leaves so much less: the first costs nothing.
_ARRIVED = 1.15

Choose = Callable[[Problem, Array, AnyShape, str], tuple[Problem, Fit, str]]


def pieces(*bends: tuple[float, float, float]) -> Pieces:
    """Arcs end to end: bending and orientation in degrees, length in mm."""
    return Pieces(tuple(Arc(np.radians(theta), np.radians(phi), length) for theta, phi, length in bends))


CLASSES: dict[str, tuple[Phantom, ...]] = {
    "arc": tuple(Arc(np.radians(t), np.radians(p), 150.0) for t, p in ((20, 40), (45, 160), (70, 290))),
    "piece of an ellipse": (EllipseArc(np.radians(35), 2.0, 0.4, 150.0), EllipseArc(np.radians(60), 0.6, 4.4, 150.0)),
    "S in a plane": (pieces((40, 30, 75), (45, 210, 75)), pieces((30, 100, 60), (50, 280, 90))),
    "two segments in space": (pieces((50, 40, 70), (45, 130, 80)), pieces((35, 200, 80), (60, 320, 65))),
    "three segments in space": (
        pieces((40, 20, 50), (35, 120, 50), (30, 250, 50)),
        pieces((35, 300, 40), (40, 60, 60), (45, 170, 50)),
    ),
    "helix": (Helix(1 / 60, 1 / 30, 0.4, 190.0),),
}


def guess(family: Family, turns: Array, length_mm: float) -> Array:
    """First guess of a family's parameters from a curve whose arcs turn by `turns` (M, 2)."""
    if family.name == "circle" or family.name.startswith("arcs"):
        count = family.count // 3
        return np.concatenate([turns.reshape(count, -1, 2).sum(1).ravel(), np.zeros(count - 1), [length_mm]])
    if family.name == "ellipse":
        return np.array([*turns.sum(0), 0.0, 0.0, length_mm])
    if family.name.startswith("polynomial"):
        way = turns.sum(0) / np.linalg.norm(turns.sum(0))
        across = spatial_like(turns, length_mm, family.count - 2)[:-1].reshape(-1, 2) @ way
        return np.concatenate([[np.arctan2(way[1], way[0])], across, [length_mm]])
    return spatial_like(turns, length_mm, family.count // 2)


def alone(family: Family, matched: bool, fits: list[Fit]) -> Choose:
    """Make what stands in for the choice: one family, from the circle to the tip or from matched centrelines.

    Its fits are kept in `fits`. What the choice does not do to begin with the circle is not timed: the guess from that
    is kept.
    """
    kept: list[Array] = []

    def choose(problem: Problem, tip: Array, any_shape: AnyShape, _: str = "") -> tuple[Problem, Fit, str]:
        if matched or not kept:
            curve: Curve3D | None = any_shape() if matched else clamped_arc(tip)
            if curve is None:
                raise Unmeasurable(Status.VIEWS_DISAGREE)
            if matched:
                problem = placed(problem, curve, problem.start)
            turns = turns_of(curve.tangent(np.linspace(0.0, curve.length_mm, INTERVALS + 1)), problem.start)
            kept[:] = [guess(family, turns, curve.length_mm)]
        fits.append(fit_family(problem, family, kept[0]))
        return problem, fits[-1], ""

    return choose


@dataclass(frozen=True, slots=True)
class Result:
    """A curve, the time that it took, and its mean distance from the true one."""

    model: str
    seconds: float
    error_mm: float


def solved(views: Mapping[str, View], rig: Rig, phantom: Phantom) -> Result | None:
    """Solve a few times; None where there is no answer."""
    seconds = []
    for _ in range(RUNS):
        start = time.thread_time()
        try:
            curve = METHODS["silhouette"].solve(views, rig, TUBE)
        except Unmeasurable:
            return None
        seconds.append(time.thread_time() - start)
    true = phantom.at(np.linspace(0.0, phantom.length_mm, 201))
    found = curve.at(np.linspace(0.0, curve.length_mm, 1601))
    return Result(curve.model, min(seconds), float(distance_to_polyline(true, found).mean()))


def fixed(views: Mapping[str, View], rig: Rig, phantom: Phantom, name: str) -> Result | None:
    """Solve with one family, from the start that leads it nearer to the edges."""
    best, least = None, np.inf
    for matched in (False, True):
        fits: list[Fit] = []
        with mock.patch.object(silhouette, "choose_family", alone(FAMILIES[name], matched, fits)):
            result = solved(views, rig, phantom)
        if result is not None and fits[-1].rms_px * _ARRIVED < least:
            best, least = result, fits[-1].rms_px
    return best


def row(name: str, phantoms: tuple[Phantom, ...], rig: Rig) -> str:
    """Line of the table: means over the shapes of a class."""
    chosen, alike, best = [], [], []
    for phantom in phantoms:
        views = ShapeSensor(rig, TUBE)(render_pair(rig, phantom, TUBE)).views
        result = solved(views, rig, phantom)
        if result is None:
            raise SystemExit(f"{name}: not measured")
        families = {family: fixed(views, rig, phantom, family) for family in FAMILIES}
        same = families[result.model]
        if same is None:
            raise SystemExit(f"{name}: {result.model} alone leads nowhere")
        chosen.append(result)
        alike.append(same)
        best.append(min((found for found in families.values() if found), key=lambda found: found.error_mm))
    errors = [np.mean([result.error_mm for result in results]) for results in (chosen, best)]
    seconds = [np.mean([result.seconds for result in results]) for results in (chosen, alike)]
    models = ", ".join(sorted({result.model for result in chosen}))
    return (
        f"| {name} | {models} | {errors[0]:.3f} | {errors[1]:.3f} | {1e3 * seconds[0]:.2f} | {1e3 * seconds[1]:.2f} | "
        f"{seconds[0] / seconds[1]:.1f} |"
    )


def table(classes: Mapping[str, tuple[Phantom, ...]], rig: Rig) -> Iterator[str]:
    """Lines of the table."""
    yield "| shape | family | error [mm] | that of the best family | time [ms] | of that family alone | ratio |"
    yield "|---|---|---|---|---|---|---|"
    for name, phantoms in classes.items():
        yield row(name, phantoms, rig)


if __name__ == "__main__":
    print(*table(CLASSES, rig_around(90.0)), sep="\n")
