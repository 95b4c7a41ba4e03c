"""How far a fitted curve may be off: from the pictures, and from the calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tubesight.core import Array, Tube
from tubesight.core.kernels import COMPILED
from tubesight.geometry.families import INTERVALS
from tubesight.geometry.rig import Rig
from tubesight.methods import fit_kernels, solve
from tubesight.methods.fit import Fit, priors
from tubesight.methods.rays import Problem, collect
from tubesight.vision.view import View


def picture_covariance(problem: Problem, fit: Fit) -> Array:
    """Covariance (P, P) of the parameters from the edges."""
    return (fit_kernels.sandwich if COMPILED else solve.sandwich)(
        problem,
        fit.jacobian,
        fit.residual_px,
        fit.weight,
        _known(problem, fit),
        fit.family.count,
        float(fit.nodes.s_mm[-1]),
    )


def _known(problem: Problem, fit: Fit) -> Array:
    """Information (P, P) on the parameters beside the rays: priors and the middle of a flat end."""
    prior, _ = priors(problem, fit.family)
    if math.isnan(problem.end_mm[0]):
        return np.diag(prior)
    _, end = solve.end_miss(problem, fit.nodes, len(prior))
    return np.diag(prior) + np.outer(end, end)


def rig_covariance(problem: Problem, fit: Fit, views: Mapping[str, View], rig: Rig, tube: Tube) -> Array:
    """Covariance (P, P) of the parameters from the calibration: ``G S G^T``, ``G = -H^-1 J^T W J_c``.

    J_c, the derivatives of the rays' misses by the calibrated parameters, are differences: each parameter is moved by a
    tenth of its deviation, and the pixels are turned into rays again.
    """
    if rig.covariance is None:
        raise ValueError("the rig carries no covariance")
    steps = np.maximum(0.1 * np.sqrt(np.diag(rig.covariance.matrix)), 1e-9)
    near = np.floor(problem.place * INTERVALS + 0.5).astype(np.int64)
    still, jacobian, near = solve.misses(problem, fit.nodes, fit.parameters, near)
    ball = None if np.isnan(problem.tip_radius_mm) else problem.tip_radius_mm
    end = None if np.isnan(problem.end_mm[0]) else problem.end_mm
    columns = []
    for name, step in zip(rig.covariance.names, steps, strict=True):
        moved = rig.perturbed(name, step)
        seen = {n: _seen_again(view, moved) for n, view in views.items()}
        there = collect(seen, moved, tube, problem.start, problem.radius_mm, ball, end)
        columns.append((solve.misses(there, fit.nodes, fit.parameters, near)[0] - still) / step)
    hessian, reduced, _, a = solve.reduced_equations(problem, jacobian, fit.weight, _known(problem, fit))
    g = np.linalg.solve(hessian, (reduced * a[:, None]).T @ np.stack(columns, 1))
    return np.asarray(g @ rig.covariance.matrix @ g.T)


def _seen_again(view: View, rig: Rig) -> View:
    """View with the rays of its edges from another calibration."""
    rays = rig.cameras[view.camera].unproject(view.edges_px)
    return replace(view, edge_rays=rays / np.linalg.norm(rays, axis=-1, keepdims=True))
