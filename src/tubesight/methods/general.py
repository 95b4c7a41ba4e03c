"""Shapes that no short family describes: splines of curvature and more pieces, from a curve found without a family."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.families import (
    BASE,
    CHAINS,
    FAMILIES,
    FINE_SPLINE,
    INTERVALS,
    Family,
    nodes_of,
    spatial_like,
)
from tubesight.geometry.matching import monotone_way
from tubesight.geometry.pose import Pose
from tubesight.methods.fit import Fit, fit_family
from tubesight.methods.rays import ROWS, Problem

# Samples of a curve by which the place of a ray is told: four an arc.
_SAMPLES = 4 * INTERVALS + 1
# The simplest family whose rms is within this factor of the best one's is taken: residuals on photographs are
# systematic, so that a criterion for independent noise would take too rich a family. A finer spline is given up where
# it cannot lower the rms by as much.
SIMPLEST_WITHIN = 1.35
# Polynomials that a spline has led to are held to less: noise alone makes their rms a twentieth larger than that of a
# spline, and no shape is a polynomial for certain.
_SMOOTHER_WITHIN = 1.15
# Fewest arcs of a piece.
_SHORTEST = 3
# Steps by which a curve of a family is laid on another one, and what holds its parameters, mm for a radian.
_LAYING_STEPS, _HELD_MM = 12, 0.3


def general_fits(
    problem: Problem, turns: Array, length_mm: float, good_px: float, curve: Curve3D | None = None
) -> dict[str, Fit]:
    """Fit splines of curvature, the finer one where the coarse one is not good, and simpler families like them.

    Parameters
    ----------
    turns, length_mm
        By how much the arcs of a curve near the edges turn (M, 2) (`tubesight.geometry.families.turns_of`), and its
        length.
    good_px
        Rms from which a spline is fine enough.
    curve
        That curve, where its points say more than its bends do: fits begin with the nearest curves of their families.
    """
    best = fit_family(problem, FAMILIES["spline"], _start("spline", turns, length_mm, problem, curve))
    fits = {"spline": best}
    if best.rms_px > good_px:
        guess = spatial_like(turns_by(best), best.nodes.s_mm[-1], FINE_SPLINE)
        finer = fit_family(problem, FAMILIES["fine_spline"], guess, best.rms_px / SIMPLEST_WITHIN)
        if finer.rms_px < best.rms_px:
            best = fits["fine_spline"] = finer
    fits |= _simpler_fits(problem, best, good_px)
    if curve is not None and min(fit.rms_px for fit in fits.values()) > good_px:
        # What ended in a valley of its own may be nearer when it begins with the curve itself.
        for name in ("arcs4", "arcs6", "fine_spline"):
            fit = fit_family(problem, FAMILIES[name], _start(name, turns, length_mm, problem, curve))
            if name not in fits or fit.rms_px < fits[name].rms_px:
                fits[name] = fit
    return fits


def _simpler_fits(problem: Problem, spline: Fit, good_px: float) -> dict[str, Fit]:
    """Fit families of fewer parameters from a spline: polynomials that are as good, pieces until they are.

    Pieces of more parameters than a good polynomial are not tried.
    """
    fits: dict[str, Fit] = {}
    fewest = spline.family.count
    turns, length_mm = turns_by(spline), spline.nodes.s_mm[-1]
    for name in ("spatial4", "spatial2"):
        guess = spatial_like(turns, length_mm, FAMILIES[name].count // 2)
        smooth = fit_family(problem, FAMILIES[name], guess, spline.rms_px)
        if smooth.rms_px > _SMOOTHER_WITHIN * spline.rms_px:
            break
        fits[name], fewest = smooth, smooth.family.count
    for pieces in (3, 4, 6):
        family = FAMILIES[f"arcs{pieces}"]
        if family.count > fewest:
            break
        bends = turns.reshape(pieces, -1, 2).sum(1)
        guess = np.concatenate([bends.ravel(), np.zeros(pieces - 1), [length_mm]])
        fits[family.name] = fit_family(problem, family, guess, spline.rms_px)
        if fits[family.name].rms_px <= good_px:
            break
    return fits


def _start(name: str, turns: Array, length_mm: float, problem: Problem, curve: Curve3D | None) -> Array:
    """Parameters of a family near a curve: as its arcs turn, then laid on its points."""
    family = FAMILIES[name]
    if name.startswith("arcs"):
        guess = _pieces_of(turns, length_mm, family.count // 3)
    else:
        guess = spatial_like(turns, length_mm, family.count // 2)
    return guess if curve is None else _laid_on(family, guess, curve, problem.start)


def _laid_on(family: Family, guess: Array, curve: Curve3D, start: Pose) -> Array:
    """Parameters (count,) of the curve of a family whose nodes are nearest to a curve (Gauss-Newton)."""
    p, best, least = np.append(guess, np.zeros(BASE)), guess, np.inf
    for _ in range(_LAYING_STEPS):
        nodes = nodes_of(family, p, start)
        miss = curve.at(nodes.s_mm / nodes.s_mm[-1] * curve.length_mm) - nodes.points
        if not (miss**2).sum() < least:
            break
        best, least = p[: family.count].copy(), float((miss**2).sum())
        slope = nodes.d_points[:, :, : family.count].reshape(-1, family.count)
        held = np.vstack([slope, _HELD_MM * np.eye(family.count)])
        p[: family.count] += np.linalg.lstsq(held, np.append(miss.ravel(), np.zeros(family.count)), rcond=None)[0]
    return best


def _pieces_of(turns: Array, length_mm: float, count: int) -> Array:
    """Parameters of `count` pieces that turn as a curve does, cut where that leaves the least within them.

    Dynamic programming over the arcs (M, 2) of the curve: of all ways to cut it the one with the least sum of squared
    deviations of each arc's turn from the mean of its piece.
    """
    size = len(turns)
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(turns, axis=0)])
    squares = np.concatenate([[0.0], np.cumsum((turns**2).sum(1))])
    first, last = np.meshgrid(np.arange(size + 1), np.arange(size + 1), indexing="ij")
    cost = squares[last] - squares[first] - ((sums[last] - sums[first]) ** 2).sum(-1) / np.maximum(last - first, 1)
    cost = np.where(last - first >= _SHORTEST, cost, np.inf)
    best, cut = cost[0], list[Array]()
    for _ in range(count - 1):
        through = best[:, None] + cost
        cut.append(through.argmin(0))
        best = through.min(0)
    ends = [size]
    for back in reversed(cut):
        ends.append(int(back[ends[-1]]))
    edges = np.array([0, *reversed(ends)])
    share = np.diff(edges)
    return np.concatenate([np.diff(sums[edges], axis=0).ravel(), np.log(share[:-1] / share[-1]), [length_mm]])


def turns_by(fit: Fit) -> Array:
    """By how much (M, 2) the arcs of a fit turn."""
    return CHAINS[fit.family.kind](fit.parameters[: fit.family.count]).turns


def placed(problem: Problem, curve: Curve3D, start: Pose) -> Problem:
    """Let a problem begin with a curve: where it starts, and at which share of its length each ray passes it.

    A tube that comes towards a camera, or crosses its own image, has places there that lengths in the picture do not
    tell; along each row they follow each other.

    Parameters
    ----------
    start
        ``base_from_start``.
    """
    points = curve.at(np.linspace(0.0, curve.length_mm, _SAMPLES))
    place = problem.place.copy()
    for row in range(len(problem.row_sd_px)):
        rays = slice(problem.row_start[row], problem.row_start[row + 1])
        if row % ROWS == ROWS - 1 or rays.stop == rays.start:
            continue
        offset = points - problem.centre_mm[row // ROWS]
        along = problem.direction[rays] @ offset.T
        squared = (offset**2).sum(1) - along**2
        place[rays] = _in_order(squared)
    return problem._replace(place=place, start_rotation=start.rotation, start_mm=start.translation_mm)


def _in_order(squared: Array) -> Array:
    """Shares (n,) of the samples nearest to each ray on the cheapest monotone way through distances (n, samples)."""
    way = monotone_way(squared, 0.0)
    ray, sample = way[np.lexsort((squared[way[:, 0], way[:, 1]], way[:, 0]))].T
    _, nearest = np.unique(ray, return_index=True)
    return np.asarray(sample[nearest] / (squared.shape[1] - 1))


def frame_along(start_mm: Array, z: Array) -> Pose:
    """Frame ``base_from_start`` with its third axis along a unit vector `z` (3,)."""
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z], 1), start_mm)
