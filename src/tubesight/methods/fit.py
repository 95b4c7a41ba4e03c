"""A family of curves fitted to the silhouette: priors, the solver, and what a fit carries."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import COMPILED
from tubesight.geometry.families import BASE, Family, Nodes
from tubesight.methods import fit_kernels, solve
from tubesight.methods.rays import Problem

# What a clamp is trusted to: place and direction of the base (standard deviations). On rendered photographs with an
# exact base the angles of a looser one (0.05) are off by a fifth more; a base that is registered 0.2 mm and 0.3 degrees
# off doubles the error of a tighter one (0.02).
CLAMP_MM, CLAMP_RAD = 0.03, np.radians(0.03)
# Where a tube without a clamp starts is seen to a few millimetres and tenths of a radian: that keeps a wrong family
# from wandering off, and weighs nothing beside the edges of the right one.
_FREE_MM, _FREE_RAD = 5.0, 0.2
# A guess of the radius from the pictures is good to this share.
_RADIUS_SHARE = 0.2
# Inverse variance that keeps what the data do not determine (a tube without a clamp along itself) from making the
# equations singular: a radian and a millimetre weigh less than a thousandth of one edge.
_RIDGE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fitted curve.

    Attributes
    ----------
    family
        Which.
    parameters
        (P,) of the family, then of the base (4), then the correction of the radius in mm where it is open.
    nodes
        The curve in the base frame.
    residual_px
        (N,) edges' distances outwards from the model, the best shifts of the pictures taken out.
    weight
        (N,) robust weights, 0 to 1.
    jacobian
        (N, P) of the distances, without shifts.
    rms_px
        Root mean square of the edges of the tube.
    tip_off_px
        Median distance of the edges of the tip from the model, in the worst view.
    """

    family: Family
    parameters: Array
    nodes: Nodes
    residual_px: Array
    weight: Array
    jacobian: Array
    rms_px: float
    tip_off_px: float


def fit_family(
    problem: Problem, family: Family, guess: Array, worth_px: float = np.inf, steps: int = solve.ITERATIONS
) -> Fit:
    """Fit one family from a first guess of its parameters.

    Parameters
    ----------
    guess
        (count,) of the family, or with what follows them (`Fit.parameters`).
    worth_px
        The fit is given up where its rms is above this and its cost no longer falls fast.
    steps
        Most steps that are taken.
    """
    prior, anchor = priors(problem, family)
    p = np.zeros(len(prior))
    p[: len(guess)] = guess
    return Fit(
        family, *(fit_kernels.fit if COMPILED else solve.fit)(problem, family, p, prior, anchor, worth_px, steps)
    )


def priors(problem: Problem, family: Family) -> tuple[Array, Array]:
    """Inverse variances (P,) of all parameters, and of those among them that are expected to be 0."""
    return _priors(family, problem.clamped, problem.radius_mm if problem.radius_open else None)


@lru_cache
def _priors(family: Family, clamped: bool, open_radius_mm: float | None) -> tuple[Array, Array]:
    count = family.count
    anchor = np.zeros(count + BASE + (open_radius_mm is not None))
    for index, sd in family.soft:
        anchor[index] = sd**-2
    if clamped:
        anchor[count : count + 2], anchor[count + 2 : count + BASE] = CLAMP_MM**-2, CLAMP_RAD**-2
    else:
        anchor[count : count + 2], anchor[count + 2 : count + BASE] = _FREE_MM**-2, _FREE_RAD**-2
    if open_radius_mm is not None:
        anchor[-1] = (_RADIUS_SHARE * open_radius_mm) ** -2
    return np.maximum(anchor, _RIDGE), anchor
