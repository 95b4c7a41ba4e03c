"""Shapes that no short family describes: splines of curvature and more pieces, from a curve found without a family."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.families import FAMILIES, FINE_SPLINE, INTERVALS, SPLINE, bends_of_pieces, spatial_like
from tubesight.geometry.matching import monotone_way
from tubesight.geometry.pose import Pose
from tubesight.methods.fit import Fit, fit_family
from tubesight.methods.rays import ROWS, Problem

# Samples of a curve by which the place of a ray is told: four an arc.
_SAMPLES = 4 * INTERVALS + 1


def general_fits(problem: Problem, curve: Curve3D, good_px: float) -> dict[str, Fit]:
    """Fit splines of curvature, the finer one where the coarse one is not good, and pieces like them.

    Parameters
    ----------
    problem
        With the places along `curve` (`placed`).
    curve
        A curve along the edges, a few tenths of a millimetre off.
    good_px
        Rms from which a spline is fine enough.
    """
    tangents = curve.tangent(np.linspace(0.0, curve.length_mm, INTERVALS + 1))
    fits: dict[str, Fit] = {}
    for name, count in (("spline", SPLINE), ("fine_spline", FINE_SPLINE)):
        guess = spatial_like(tangents, curve.length_mm, problem.start, count)
        fits[name] = fit_family(problem, FAMILIES[name], guess)
        if fits[name].rms_px <= good_px:
            break
    smooth = fits[name].parameters[: FAMILIES[name].count]
    for pieces in (4, 6):
        bends = bends_of_pieces(smooth[:-1].reshape(-1, 2), pieces)
        guess = np.concatenate([bends.ravel(), np.zeros(pieces - 1), smooth[-1:]])
        fits[f"arcs{pieces}"] = fit_family(problem, FAMILIES[f"arcs{pieces}"], guess, fits[name].rms_px)
        if fits[f"arcs{pieces}"].rms_px <= good_px:
            break
    return fits


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
    nearest: list[list[int]] = [[] for _ in range(len(squared))]
    for ray, sample in monotone_way(squared, 0.0):
        nearest[ray].append(sample)
    chosen = [some[int(np.argmin(squared[i, some]))] for i, some in enumerate(nearest)]
    return np.asarray(np.array(chosen, dtype=np.float64) / (squared.shape[1] - 1))
