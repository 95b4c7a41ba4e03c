"""Compiled twins of the loops of `tubesight.methods.solve`: `fit` and `sandwich`."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, sealed
from tubesight.core.kernels import compiled, part
from tubesight.geometry.families import INTERVALS, Family, Nodes
from tubesight.methods.curve_kernels import NodeArrays, empty_chain, empty_nodes, nodes_of
from tubesight.methods.kernels import (
    factor,
    median_size,
    mixed_with_shifts,
    normal_equations,
    rms,
    shift_factors,
    stepped,
    substitute,
    try_step,
    weights,
    without_shifts,
)
from tubesight.methods.rays import BIAS_PX, ROWS, Problem
from tubesight.methods.solve import (
    BLOCK_MM,
    CIRCLE,
    CONVERGED_MM,
    DAMPING,
    LAST_MM,
    LINEAR_MM,
    NUISANCES,
    REWEIGHTED,
    SHORTEST,
    SLOW,
)


def fit(
    problem: Problem, family: Family, p: Array, prior: Array, anchor: Array, worth_px: float, steps: int
) -> tuple[Array, Nodes, Array, Array, Array, float, float]:
    """Twin of `tubesight.methods.solve.fit`."""
    p, nodes, residual, weight, jacobian, root, off = levenberg_marquardt(
        problem, family.kind, family.count, p.copy(), prior, anchor, worth_px, steps
    )
    points, tangents, curvature, s, *derivatives = nodes
    return (
        p,
        Nodes(sealed(points), sealed(tangents), curvature, sealed(s), *derivatives),
        residual,
        weight,
        jacobian,
        root,
        off,
    )


@compiled
def levenberg_marquardt(
    problem: Problem, kind: int, count: int, p: Array, prior: Array, anchor: Array, worth_px: float, steps: int
) -> tuple[Array, NodeArrays, Array, Array, Array, float, float]:
    """Loop of `fit`, which overwrites `p`; each step is tried in a second set of arrays."""
    n, size = len(problem.place), len(p)
    chain = empty_chain(count)
    nodes, other_nodes = empty_nodes(count), empty_nodes(count)
    miss, other_miss, residual = np.empty(n), np.empty(n), np.empty(n)
    jacobian, other_jacobian = np.empty((n, size)), np.empty((n, size))
    end, other_end = np.empty(size), np.empty(size)
    a, weight = np.empty(n), np.empty(n)
    factors = np.empty((len(problem.focal_px), NUISANCES, NUISANCES))
    hessian, gradient, trial = np.empty((size, size)), np.empty(size), np.empty(size)
    near, there = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        near[i] = int(problem.place[i] * INTERVALS + 0.5)
    end_off = try_step(problem, kind, count, p, chain, nodes, near, miss, jacobian, end)
    weights(problem, miss, weight)
    damping = DAMPING
    for _ in range(steps):
        better = False
        cost, last = reweighted(
            problem, p, prior, anchor, weight, miss, jacobian, end, end_off, nodes, damping, worth_px, count,
            a, factors, residual, hessian, gradient, trial, other_miss,
        )  # fmt: skip
        if last:
            p[:] = trial
            miss, other_miss = other_miss, miss
            nodes_of(kind, count, p, problem.start_rotation, problem.start_mm, chain, nodes)
            break
        for _ in range(8):
            if trial[count - 1] > SHORTEST * p[count - 1]:
                there[:] = near
                trial_end = try_step(
                    problem, kind, count, trial, chain, other_nodes, there, other_miss, other_jacobian, other_end
                )
                trial_cost = without_shifts(problem, other_miss, a, factors, residual)
                trial_cost += trial_end * trial_end + pull(anchor, trial)
                if trial_cost <= cost * (1 + 1e-9):
                    better = True
                    break
            damping *= 6.0
            stepped(p, hessian, gradient, damping, count, trial)
        if not better:
            break
        end_off, damping = trial_end, max(damping / 10, 1e-9)
        p[:] = trial
        near[:] = there
        nodes, other_nodes = other_nodes, nodes
        miss, other_miss = other_miss, miss
        jacobian, other_jacobian = other_jacobian, jacobian
        end, other_end = other_end, end
        weights(problem, residual, weight)
        if trial_cost > SLOW * cost and rms(problem, residual) > worth_px:
            break
    shift_factors(problem, weight, a, factors)
    without_shifts(problem, miss, a, factors, residual)
    return p, nodes, residual, weight, jacobian, rms(problem, residual), tip_off(problem, residual)


@part
def reweighted(
    problem: Problem,
    p: Array,
    prior: Array,
    anchor: Array,
    weight: Array,
    miss: Array,
    jacobian: Array,
    end: Array,
    end_off: float,
    nodes: NodeArrays,
    damping: float,
    worth_px: float,
    count: int,
    a: Array,
    factors: Array,
    residual: Array,
    hessian: Array,
    gradient: Array,
    trial: Array,
    ahead_miss: Array,
) -> tuple[float, bool]:
    """Twin of `tubesight.methods.solve.reweighted`, written into what follows `count`; returns cost and `last`."""
    last_mm = LAST_MM if count == CIRCLE else CONVERGED_MM
    earlier, cost, last = np.inf, 0.0, False
    for again in range(REWEIGHTED + 1):
        cost = equations(
            problem, p, prior, anchor, weight, miss, jacobian, end, end_off, a, factors, residual, hessian, gradient
        )
        stepped(p, hessian, gradient, damping, count, trial)
        moved = movement(nodes, p, trial)
        if not moved < LINEAR_MM:
            break
        end_ahead = ahead(miss, jacobian, end, end_off, p, trial, ahead_miss)
        ahead_cost = without_shifts(problem, ahead_miss, a, factors, residual)
        ahead_cost += end_ahead * end_ahead + pull(anchor, trial)
        settled = moved < CONVERGED_MM or abs(moved - earlier) < CONVERGED_MM
        hopeless = ahead_cost > SLOW * cost and rms(problem, residual) > worth_px
        last = hopeless or (settled and moved < last_mm)
        if hopeless or settled or again == REWEIGHTED:
            break
        weights(problem, residual, weight)
        earlier = moved
    return cost, last


@part
def equations(
    problem: Problem,
    p: Array,
    prior: Array,
    anchor: Array,
    weight: Array,
    miss: Array,
    jacobian: Array,
    end: Array,
    end_off: float,
    a: Array,
    factors: Array,
    residual: Array,
    hessian: Array,
    gradient: Array,
) -> float:
    """Write the normal equations of a step with all that is known, `a`, `factors` and `residual`; return the cost."""
    shift_factors(problem, weight, a, factors)
    cost = without_shifts(problem, miss, a, factors, residual) + end_off * end_off + pull(anchor, p)
    for q in range(len(p)):
        gradient[q] = end[q] * end_off + anchor[q] * p[q]
        for r in range(len(p)):
            hessian[q, r] = end[q] * end[r]
        hessian[q, q] += prior[q]
    normal_equations(problem, jacobian, residual, a, factors, hessian, gradient)
    return cost


@part
def ahead(miss: Array, jacobian: Array, end: Array, end_off: float, p: Array, trial: Array, moved_miss: Array) -> float:
    """Misses after a short step, written into `moved_miss`; returns the miss of a flat end."""
    for i in range(len(miss)):
        total = miss[i]
        for q in range(len(p)):
            total += jacobian[i, q] * (trial[q] - p[q])
        moved_miss[i] = total
    for q in range(len(p)):
        end_off += end[q] * (trial[q] - p[q])
    return end_off


@part
def pull(anchor: Array, p: Array) -> float:
    """Cost of parameters that are expected to be 0."""
    cost = 0.0
    for q in range(len(p)):
        cost += anchor[q] * p[q] * p[q]
    return cost


@part
def movement(nodes: NodeArrays, p: Array, trial: Array) -> float:
    """Twin of `tubesight.methods.solve.movement`, of the step from `p` to `trial`."""
    tangents, d_points = nodes[1], nodes[4]
    largest = 0.0
    for i in range(INTERVALS + 1):
        along, square = 0.0, 0.0
        for c in range(3):
            off = 0.0
            for q in range(d_points.shape[2]):
                off += d_points[i, c, q] * (trial[q] - p[q])
            along += off * tangents[i, c]
            square += off * off
        square -= along * along if i < INTERVALS else 0.0
        largest = square if square > largest else largest
    return np.sqrt(largest)  # type: ignore[no-any-return]


@part
def tip_off(problem: Problem, residual: Array) -> float:
    """Twin of `tubesight.methods.solve.tip_off`."""
    most = 0.0
    for view in range(len(problem.focal_px)):
        low, high = problem.row_start[ROWS * view + ROWS - 1], problem.row_start[ROWS * view + ROWS]
        if high > low:
            most = max(most, median_size(residual, low, high))
    return most


@compiled
def sandwich(
    problem: Problem, jacobian: Array, residual: Array, weight: Array, known: Array, count: int, length_mm: float
) -> Array:
    """Twin of `tubesight.methods.solve.sandwich`."""
    n, size = jacobian.shape
    views = len(problem.focal_px)
    a, factors = np.empty(n), np.empty((views, NUISANCES, NUISANCES))
    shift_factors(problem, weight, a, factors)
    mixed = np.empty((views, NUISANCES, size))
    mixed_with_shifts(problem, jacobian, a, mixed)
    priors, hessian = known.copy(), np.empty((size, size))
    for view in range(views):
        substitute(factors[view], mixed[view])
        for k in range(NUISANCES):
            sd = BIAS_PX if k == 0 else problem.lobe_sd_px[ROWS * view + (k - 1) // 2]
            for q in range(size):
                for r in range(size):
                    priors[q, r] += mixed[view, k, q] * mixed[view, k, r] / (sd * sd)
    for q in range(size):
        for r in range(size):
            hessian[q, r] = priors[q, r]
    together, independent = np.zeros((size, size)), np.zeros((size, size))
    blocks = gradients(problem, jacobian, residual, a, mixed, length_mm, hessian, together, independent)
    factor(hessian)
    inverse = np.zeros((size, size))
    for q in range(size):
        inverse[q, q] = 1.0
    substitute(hessian, inverse)
    more, excess = blocks / max(blocks - count, 1), 0.0
    for q in range(size):
        for r in range(size):
            excess += inverse[q, r] * (more * together[q, r] - independent[q, r])
    for q in range(size):
        for r in range(size):
            priors[q, r] += more * together[q, r] if excess > 0 else independent[q, r]
    substitute(hessian, priors)
    # The middle is symmetric: the second inverse acts on the transposed product.
    covariance = np.empty((size, size))
    for q in range(size):
        for r in range(size):
            covariance[q, r] = priors[r, q]
    substitute(hessian, covariance)
    return covariance


@part
def gradients(
    problem: Problem,
    jacobian: Array,
    residual: Array,
    a: Array,
    shares: Array,
    length_mm: float,
    hessian: Array,
    together: Array,
    independent: Array,
) -> int:
    """Add the rays' Hessian and the squares of their gradients, by blocks and one by one; return how many blocks."""
    size = jacobian.shape[1]
    per_way = max(length_mm / BLOCK_MM, 1.0)
    total, reduced = np.zeros(size), np.empty(size)
    blocks = 0
    for row in range(len(problem.row_sd_px)):
        view, k, tip = row // ROWS, 1 + 2 * (row % ROWS), row % ROWS == ROWS - 1
        block = -1
        low, high = problem.row_start[row], problem.row_start[row + 1]
        for i in range(low, high):
            now = 0 if tip else int(np.floor(problem.place[i] * per_way))
            if now != block:
                add_square(total, 1.0, together)
                for q in range(size):
                    total[q] = 0.0
                block = now
                blocks += 1
            u, v = problem.lobes[i, 0], problem.lobes[i, 1]
            for q in range(size):
                reduced[q] = jacobian[i, q] - shares[view, 0, q] - u * shares[view, k, q] - v * shares[view, k + 1, q]
                total[q] += reduced[q] * a[i] * residual[i]
            add_square(reduced, a[i], hessian)
            add_square(reduced, (a[i] * residual[i]) ** 2, independent)
    add_square(total, 1.0, together)
    return blocks


@part
def add_square(vector: Array, factor_: float, matrix: Array) -> None:
    """Add a vector's outer product with itself to a matrix."""
    for q in range(len(vector)):
        x = factor_ * vector[q]
        for r in range(len(vector)):
            matrix[q, r] += x * vector[r]
