"""How far a fitted curve may be off: from the pictures, and from the calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tubesight.core import Array, Tube
from tubesight.core.kernels import COMPILED
from tubesight.geometry.camera import Camera
from tubesight.geometry.families import INTERVALS
from tubesight.geometry.rig import Rig
from tubesight.methods import fit_kernels, solve
from tubesight.methods.fit import Fit, priors
from tubesight.methods.rays import ROWS, Problem, unprojected, used_pixels
from tubesight.vision.view import View

# Step of the rays' place in differences: the miss is linear over a thousandth of a millimetre.
_STEP_MM = 1e-3


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
    """Information (P, P) on the parameters beside the rays: priors and where a flat or open end is."""
    prior, _ = priors(problem, fit.family)
    if math.isnan(problem.end_mm[0]):
        return np.diag(prior)
    _, end = solve.end_miss(problem, fit.nodes, len(prior))
    return np.diag(prior) + np.outer(end, end)


def rig_covariance(problem: Problem, fit: Fit, views: Mapping[str, View], rig: Rig, tube: Tube) -> Array:
    """Covariance (P, P) of the parameters from the calibration: ``G S G^T``, ``G = -H^-1 J^T W J_c``.

    J_c are the derivatives of the rays' misses by the calibrated parameters: each parameter moves the rays of one
    camera, whose pixels stay; a ray's miss changes with where it passes the tube.
    """
    if rig.covariance is None:
        raise ValueError("the rig carries no covariance")
    by_place, depth = _by_place(problem, fit)
    pixels = {name: used_pixels(view, tube) for name, view in views.items()}
    columns = np.zeros((len(problem.place), len(rig.covariance.names)))
    for k, moved in enumerate(_moved(rig)):
        if moved.name not in pixels:
            continue
        view = list(views).index(moved.name)
        at = slice(problem.row_start[ROWS * view], problem.row_start[ROWS * view + ROWS])
        rays = unprojected(moved.camera, pixels[moved.name])
        direction = rays / np.sqrt((rays * rays).sum(1, keepdims=True)) @ moved.rotation
        shift = (moved.centre_mm - problem.centre_mm[view]) + depth[at, None] * (direction - problem.direction[at])
        columns[at, k] = (by_place[at] * shift).sum(1) / moved.step
    hessian, reduced, _, a = solve.reduced_equations(problem, fit.jacobian, fit.weight, _known(problem, fit))
    g = np.linalg.solve(hessian, (reduced * a[:, None]).T @ columns)
    return np.asarray(g @ rig.covariance.matrix @ g.T)


def _by_place(problem: Problem, fit: Fit) -> tuple[Array, Array]:
    """Differentiate each ray's miss by where it passes the tube, (N, 3), with its depth (N,) there."""
    near = np.floor(problem.place * INTERVALS + 0.5).astype(np.int64)
    still, _, near = solve.misses(problem, fit.nodes, fit.parameters, near)
    columns = []
    for axis in np.eye(3) * _STEP_MM:
        there = problem._replace(centre_mm=problem.centre_mm + axis)
        columns.append((solve.misses(there, fit.nodes, fit.parameters, near)[0] - still) / _STEP_MM)
    centre = problem.centre_mm[solve.row_of(problem) // ROWS]
    return np.stack(columns, 1), ((fit.nodes.points[near] - centre) * problem.direction).sum(1)


class _Moved(NamedTuple):
    """A camera with one of its calibrated parameters moved by a step."""

    name: str
    camera: Camera
    rotation: Array
    centre_mm: Array
    step: float


@lru_cache(maxsize=4)
def _moved(rig: Rig) -> tuple[_Moved, ...]:
    """Cameras with each calibrated parameter moved by a tenth of its deviation."""
    assert rig.covariance is not None
    moved = []
    steps = np.maximum(0.1 * np.sqrt(np.diag(rig.covariance.matrix)), 1e-9)
    for parameter, step in zip(rig.covariance.names, steps, strict=True):
        name, there = parameter.rsplit(".", 1)[0], rig.perturbed(parameter, step)
        pose = there.camera_from_base[name]
        moved.append(_Moved(name, there.cameras[name], np.array(pose.rotation), there.centre_mm(name), float(step)))
    return tuple(moved)
