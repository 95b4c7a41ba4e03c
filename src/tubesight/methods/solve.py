"""The silhouette fit in NumPy: readable, and the judge of its compiled twins in `tubesight.methods.kernels`.

The residual of a ray is ``g(p) - N n``: p are the few parameters of curve, base and radius; n are shifts of the edges
in the pictures, `NUISANCES` a view (all its edges; two lobes of each of its rows), which enter linearly. For weights a
they are eliminated exactly, ``n = (N^T a N + P)^-1 N^T a g`` (variable projection: Golub & Pereyra 1973), and leave the
normal equations of p with their Schur complement.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tubesight.core import Array, Indices
from tubesight.geometry.families import BASE, INTERVALS, Family, Nodes, nodes_of
from tubesight.methods.rays import BIAS_PX, ROWS, Problem

# Shifts of a view: of all edges, and two lobes of each row.
NUISANCES = 1 + 2 * ROWS
# Edges farther off than this many robust deviations carry no weight (Tukey's biweight: 4.7 for 95 % efficiency).
TUKEY = 4.7
# No edge counts with more than this in the rms that families are compared by: what crosses the tube is not its shape.
RMS_CAP_PX = 3.0
ITERATIONS = 30
# Movement of the curve under which the fit has converged: a tenth of what the best pictures tell.
CONVERGED_MM = 2e-3
# Movement up to which misses are linear: it bends a tube's normal by a hundredth, so that they are off by 0.005 mm.
LINEAR_MM = 0.5
# Length up to which a step of a circle, told by its number of parameters, can be the last: on photographs such steps
# leave 2 % of themselves, here a third of `CONVERGED_MM`. Ratios of axes and shares of pieces are not that linear.
CIRCLE, LAST_MM = 3, 0.03
# How often weights follow before the curve is measured again: each time they change a third as much.
REWEIGHTED = 2
# A step that leaves more than this share of the cost shows how far a family can come.
SLOW = 0.7
# Scale of a row over which a fit is rough: outliers are not known yet, and it is the model that errs, by about a pixel
# everywhere, however smooth a row is.
ROUGH_PX, MODEL_SD_PX = 0.5, 1.0
# Residuals along one row hang together over about this length of tube.
BLOCK_MM = 25.0
# Longest step of an angle (rad) or a pure number: families are far from linear beyond it.
STEP_MAX = 0.5
# First damping of the steps, and the share of the length that none may cut it to.
DAMPING = 1e-3
SHORTEST = 0.3


def row_of(problem: Problem) -> Indices:
    """Row (N,) of each ray."""
    return np.repeat(np.arange(len(problem.row_sd_px)), np.diff(problem.row_start))


def misses(problem: Problem, nodes: Nodes, p: Array, near: Indices) -> tuple[Array, Array, Indices]:
    """Measure how far each ray misses the surface of a curve's tube, outwards, in pixels at that depth.

    The derivative of the distance by a parameter is the unit normal times the derivative of the nearest point: at the
    nearest point its place on the curve does not matter. A ray of the tip's contour that passes it on the wrong side
    has a negative distance.

    Parameters
    ----------
    near
        (N,) nodes from which each ray walks to its nearest one.

    Returns
    -------
    miss_px, jacobian, near
        (N,), (N, P), (N,); P counts the parameters of curve and base, and the radius where it is open.
    """
    row = row_of(problem)
    view, tip = row // ROWS, row % ROWS == ROWS - 1
    d = problem.direction
    relative = nodes.points[None] - problem.centre_mm[view][:, None]
    along = np.einsum("nmk,nk->nm", relative, d)
    squared = (relative**2).sum(-1) - along**2
    best = np.where(tip, INTERVALS, _descend(squared, near))
    rows = np.arange(len(d))
    depth = along[rows, best]
    w = relative[rows, best] - depth[:, None] * d
    t = nodes.tangents[best]
    t = t - (t * d).sum(1, keepdims=True) * d
    k = nodes.curvature[best]
    k = k - (k * d).sum(1, keepdims=True) * d
    bottom = (t * t).sum(1) + (w * k).sum(1)
    spacing = nodes.s_mm[-1] / INTERVALS
    shift = -(w * t).sum(1) / np.where(np.abs(bottom) > 1e-6, bottom, np.inf)
    shift = np.where(
        tip, 0.0, np.clip(shift, np.where(best > 0, -spacing, 0.0), np.where(best < INTERVALS, spacing, 0))
    )
    off = w + t * shift[:, None] + k * (shift**2 / 2)[:, None]
    distance = np.sqrt((off * off).sum(1))
    axis = problem.tip_axis[view]
    outwards = d - (d * axis).sum(1, keepdims=True) * axis
    distance = np.where(tip & ((off * outwards).sum(1) > 0), -distance, distance)
    to_px = problem.focal_px[view] / depth
    open_radius = p[-1] if problem.radius_open else 0.0
    ball = tip & np.isfinite(problem.tip_radius_mm)
    miss = (distance - np.where(ball, problem.tip_radius_mm, problem.radius_mm + open_radius)) * to_px
    normal = off * (to_px / distance)[:, None]
    share = (np.abs(shift) / spacing)[:, None, None]
    other = best + np.sign(shift).astype(np.int64)
    moved = nodes.d_points[best] * (1 - share) + nodes.d_points[other] * share
    jacobian = np.einsum("nkp,nk->np", moved, normal)
    if problem.radius_open:
        jacobian = np.column_stack([jacobian, np.where(ball, 0.0, -to_px)])
    return miss, jacobian, best


def _descend(squared: Array, near: Indices) -> Indices:
    """Nearest nodes (N,), each found by walking downhill from its start: what the distance continues to."""
    best = near.copy()
    rows = np.arange(len(best))
    last = squared.shape[1] - 1
    forwards = squared[rows, np.minimum(best + 1, last)] < squared[rows, best]
    step = np.where(forwards, 1, -1)
    while True:
        after = np.clip(best + step, 0, last)
        better = squared[rows, after] < squared[rows, best]
        if not better.any():
            return np.asarray(best)
        best = np.where(better, after, best)


def end_miss(problem: Problem, nodes: Nodes, size: int) -> tuple[float, Array]:
    """Measure how far a flat end lies from its face along the tube, in deviations, with derivatives (P,)."""
    jacobian = np.zeros(size)
    if np.isnan(problem.end_mm[0]):
        return 0.0, jacobian
    heading = nodes.tangents[-1]
    jacobian[: nodes.d_points.shape[2]] = heading @ nodes.d_points[-1] / problem.end_sd_mm
    return float((nodes.points[-1] - problem.end_mm) @ heading) / problem.end_sd_mm, jacobian


def weights(problem: Problem, residual: Array) -> Array:
    """Tukey's biweight by rows; where a row is far off, all of it counts alike, and the farthest less (Cauchy)."""
    weight = np.ones(len(residual))
    for row, (low, high) in enumerate(zip(problem.row_start[:-1], problem.row_start[1:], strict=True)):
        if high == low:
            continue
        r = residual[low:high]
        sd = problem.row_sd_px[row]
        scale = max(1.4826 * float(np.median(np.abs(r))), sd)
        if scale > ROUGH_PX:
            weight[low:high] = sd**2 / (sd**2 + MODEL_SD_PX**2) / (1 + (r / (3 * scale + MODEL_SD_PX)) ** 2)
        else:
            weight[low:high] = np.clip(1 - (r / (TUKEY * scale)) ** 2, 0, None) ** 2
    return weight


def precision(problem: Problem, weight: Array) -> Array:
    """Inverse variances (N,) of the rays: robust weights over each row's roughness squared."""
    return np.asarray(weight / problem.row_sd_px[row_of(problem)] ** 2)


def shifts(problem: Problem, view: int) -> tuple[slice, Array, Array]:
    """Rays of a view, their derivatives (n, K) by its shifts, and the shifts' inverse variances (K,)."""
    rows = problem.row_start[ROWS * view : ROWS * view + ROWS + 1]
    design = np.zeros((rows[-1] - rows[0], NUISANCES))
    design[:, 0] = 1.0
    for k in range(ROWS):
        at = slice(rows[k] - rows[0], rows[k + 1] - rows[0])
        design[at, 1 + 2 * k : 3 + 2 * k] = problem.lobes[rows[k] : rows[k + 1]]
    lobes = problem.lobe_sd_px[ROWS * view : ROWS * view + ROWS]
    return slice(rows[0], rows[-1]), design, np.append(BIAS_PX**-2, np.repeat(lobes**-2, 2))


def without_shifts(problem: Problem, miss: Array, a: Array) -> tuple[Array, float]:
    """Residuals (N,) with the best shifts taken out, and their weighted sum of squares with that of the shifts."""
    residual, cost = miss.copy(), 0.0
    for view in range(len(problem.focal_px)):
        at, design, prior = shifts(problem, view)
        weighted = design * a[at, None]
        shift = np.linalg.solve(design.T @ weighted + np.diag(prior), weighted.T @ miss[at])
        residual[at] -= design @ shift
        cost += float(a[at] @ residual[at] ** 2 + prior @ shift**2)
    return residual, cost


def normal_equations(problem: Problem, jacobian: Array, residual: Array, a: Array) -> tuple[Array, Array]:
    """Hessian (P, P) and gradient (P,) of the rays' part of the cost, the shifts eliminated."""
    hessian = jacobian.T @ (jacobian * a[:, None])
    for view in range(len(problem.focal_px)):
        at, design, prior = shifts(problem, view)
        weighted = design * a[at, None]
        mixed = weighted.T @ jacobian[at]
        hessian -= mixed.T @ np.linalg.solve(design.T @ weighted + np.diag(prior), mixed)
    return hessian, jacobian.T @ (a * residual)


def rms(problem: Problem, residual: Array) -> float:
    """Root mean square of the tube's edges: rows count by their smoothness, and no edge more than `RMS_CAP_PX`."""
    row = row_of(problem)
    inverse = np.where(row % ROWS < ROWS - 1, problem.row_sd_px[row] ** -2, 0.0)
    return float(np.sqrt((inverse * np.minimum(np.abs(residual), RMS_CAP_PX) ** 2).sum() / inverse.sum()))


def tip_off(problem: Problem, residual: Array) -> float:
    """Largest median distance of the edges of a tip from the model, of all views; 0 without such edges."""
    start = problem.row_start
    tips = [np.abs(residual[start[k] : start[k + 1]]) for k in range(ROWS - 1, len(start) - 1, ROWS)]
    return max(float(np.median(row)) if len(row) else 0.0 for row in tips)


def movement(nodes: Nodes, step: Array) -> float:
    """Measure how far a short step (P,) of the parameters moves a curve: across itself, or at its end in any way."""
    off = nodes.d_points @ step[: nodes.d_points.shape[2]]
    off[:-1] -= (off * nodes.tangents).sum(1, keepdims=True)[:-1] * nodes.tangents[:-1]
    return float(np.sqrt((off * off).sum(1).max()))


class Look(NamedTuple):
    """A curve as `misses` and `end_miss` see it."""

    nodes: Nodes
    miss: Array
    jacobian: Array
    near: Indices
    end: float
    end_jacobian: Array


class Step(NamedTuple):
    """A step from `p` to `trial`, with what it was found by.

    `last` tells that no measurement is needed after it: `ahead` are the misses then.
    """

    weight: Array
    a: Array
    cost: float
    hessian: Array
    gradient: Array
    trial: Array
    ahead: Array
    last: bool


def fit(
    problem: Problem, family: Family, p: Array, prior: Array, anchor: Array, worth_px: float, steps: int
) -> tuple[Array, Nodes, Array, Array, Array, float, float]:
    """Levenberg-Marquardt steps with robust weights.

    Over a short step (`LINEAR_MM`) misses change linearly: weights follow them before the curve is measured again, and
    the last step needs no measurement.

    Parameters
    ----------
    p
        (P,) first guess of the parameters of family, base and, where it is open, the radius' correction.
    prior, anchor
        (P,) inverse variances in the Hessian, and those that also pull to zero.
    worth_px
        The fit is given up where its rms is above this and its cost no longer falls fast (`SLOW`).
    steps
        Most steps that are taken.

    Returns
    -------
    p, nodes, residual, weight, jacobian, rms, tip_off
    """
    count = family.count
    here = look(problem, family, p, np.floor(problem.place * INTERVALS + 0.5).astype(np.int64))
    weight = weights(problem, here.miss)
    damping = DAMPING
    for _ in range(steps):
        step = reweighted(problem, here, p, prior, anchor, weight, damping, worth_px, count)
        weight, trial = step.weight, step.trial
        if step.last:
            p = trial
            here = here._replace(nodes=nodes_of(family, p[: count + BASE], problem.start), miss=step.ahead)
            break
        for _ in range(8):
            if trial[count - 1] > SHORTEST * p[count - 1]:
                there = look(problem, family, trial, here.near)
                residual, cost = cost_of(problem, trial, anchor, there.miss, there.end, step.a)
                if cost <= step.cost * (1 + 1e-9):
                    break
            damping *= 6.0
            trial = stepped(p, step.hessian, step.gradient, damping, count)
        else:
            break
        p, here, damping = trial, there, max(damping / 10, 1e-9)
        weight = weights(problem, residual)
        if cost > SLOW * step.cost and rms(problem, residual) > worth_px:
            break
    residual, _ = without_shifts(problem, here.miss, precision(problem, weight))
    return p, here.nodes, residual, weight, here.jacobian, rms(problem, residual), tip_off(problem, residual)


def reweighted(
    problem: Problem,
    here: Look,
    p: Array,
    prior: Array,
    anchor: Array,
    weight: Array,
    damping: float,
    worth_px: float,
    count: int,
) -> Step:
    """Step from `p`, with weights that have followed it where it is short."""
    last_mm = LAST_MM if count == CIRCLE else CONVERGED_MM
    earlier = np.inf
    for again in range(REWEIGHTED + 1):
        a = precision(problem, weight)
        residual, cost = cost_of(problem, p, anchor, here.miss, here.end, a)
        hessian, gradient = normal_equations(problem, here.jacobian, residual, a)
        hessian += np.outer(here.end_jacobian, here.end_jacobian) + np.diag(prior)
        gradient += here.end_jacobian * here.end + anchor * p
        trial = stepped(p, hessian, gradient, damping, count)
        ahead = here.miss + here.jacobian @ (trial - p)
        step = Step(weight, a, cost, hessian, gradient, trial, ahead, False)
        moved = movement(here.nodes, trial - p)
        if not moved < LINEAR_MM:
            return step
        end = here.end + float(here.end_jacobian @ (trial - p))
        residual, ahead_cost = cost_of(problem, trial, anchor, ahead, end, a)
        settled = moved < CONVERGED_MM or abs(moved - earlier) < CONVERGED_MM
        hopeless = ahead_cost > SLOW * cost and rms(problem, residual) > worth_px
        if hopeless or settled or again == REWEIGHTED:
            break
        weight, earlier = weights(problem, residual), moved
    return step._replace(last=hopeless or (settled and moved < last_mm))


def look(problem: Problem, family: Family, p: Array, near: Indices) -> Look:
    """Look at the curve of parameters `p` (P,)."""
    nodes = nodes_of(family, p[: family.count + BASE], problem.start)
    return Look(nodes, *misses(problem, nodes, p, near), *end_miss(problem, nodes, len(p)))


def cost_of(problem: Problem, p: Array, anchor: Array, miss: Array, end: float, a: Array) -> tuple[Array, float]:
    """Residuals (N,) without shifts, and the cost with that of the end and of the parameters."""
    residual, cost = without_shifts(problem, miss, a)
    return residual, cost + end**2 + float(anchor @ p**2)


def stepped(p: Array, hessian: Array, gradient: Array, damping: float, count: int) -> Array:
    """Parameters (P,) after a Levenberg-Marquardt step, cut to `STEP_MAX`."""
    move = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
    return np.asarray(p - move * min(1.0, STEP_MAX / max(float(np.abs(move[: count - 1]).max()), 1e-9)))


def reduced_equations(
    problem: Problem, jacobian: Array, weight: Array, known: Array
) -> tuple[Array, Array, Array, Array]:
    """Eliminate the shifts from the Jacobian: Hessian, Jacobian, what is known, precisions.

    `known` (P, P) is the information on the parameters beside the rays; returned with that on the shifts, which follow
    the parameters.
    """
    a = precision(problem, weight)
    reduced, priors = jacobian.copy(), known
    for view in range(len(problem.focal_px)):
        at, design, inverse = shifts(problem, view)
        weighted = design * a[at, None]
        share = np.linalg.solve(design.T @ weighted + np.diag(inverse), weighted.T @ jacobian[at])
        reduced[at] -= design @ share
        priors = priors + share.T @ (inverse[:, None] * share)
    return priors + reduced.T @ (reduced * a[:, None]), reduced, priors, a


def sandwich(
    problem: Problem, jacobian: Array, residual: Array, weight: Array, known: Array, count: int, length_mm: float
) -> Array:
    """Covariance (P, P) of the parameters from the edges: ``H^-1 M H^-1``.

    M sums the gradients of blocks of one row over `BLOCK_MM` of tube, so that correlated residuals count as often as
    they are independent, and adds what is `known` (P, P) beside the rays, and the shifts of each row. Blocks are
    corrected for the freedom that the `count` parameters of the curve took.
    """
    hessian, reduced, priors, a = reduced_equations(problem, jacobian, weight, known)
    gradient = reduced * (a * residual)[:, None]
    blocks = np.floor(problem.place * max(length_mm / BLOCK_MM, 1.0)).astype(np.int64)
    row = row_of(problem)
    key = row * 1000 + np.where(row % ROWS == ROWS - 1, 0, blocks)
    labels, index = np.unique(key, return_inverse=True)
    sums = np.zeros((len(labels), len(known)))
    np.add.at(sums, index, gradient)
    inverse = np.linalg.inv(hessian)
    together = sums.T @ sums * len(labels) / max(len(labels) - count, 1)
    independent = gradient.T @ gradient
    middle = together if np.trace(inverse @ together) > np.trace(inverse @ independent) else independent
    return np.asarray(inverse @ (middle + priors) @ inverse)
