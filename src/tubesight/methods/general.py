"""Shapes that no short family describes: splines of curvature and more pieces, from a curve found without a family."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.families import (
    CHAINS,
    FAMILIES,
    FINE_SPLINE,
    INTERVALS,
    SPLINE,
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


def general_fits(problem: Problem, turns: Array, length_mm: float, good_px: float) -> dict[str, Fit]:
    """Fit splines of curvature, the finer one where the coarse one is not good, and simpler families like them.

    Parameters
    ----------
    turns, length_mm
        By how much the arcs of a curve near the edges turn (M, 2) (`tubesight.geometry.families.turns_of`), and its
        length.
    good_px
        Rms from which a spline is fine enough.
    """
    best = fit_family(problem, FAMILIES["spline"], spatial_like(turns, length_mm, SPLINE))
    fits = {"spline": best}
    if best.rms_px > good_px:
        guess = spatial_like(turns_by(best), best.nodes.s_mm[-1], FINE_SPLINE)
        finer = fit_family(problem, FAMILIES["fine_spline"], guess, best.rms_px / SIMPLEST_WITHIN)
        if finer.rms_px < best.rms_px:
            best = fits["fine_spline"] = finer
    return fits | _simpler_fits(problem, best, good_px)


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
