"""Compiled twins of the loops of `tubesight.methods.solve`: `fit` and `sandwich`."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import compiled
from tubesight.geometry.families import INTERVALS, Family, Nodes
from tubesight.methods.curve_kernels import NodeArrays, empty_chain, empty_nodes
from tubesight.methods.kernels import (
    factor,
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
from tubesight.methods.solve import BLOCK_MM, CONVERGED_MM, DAMPING, NUISANCES, SHORTEST, SLOW


def fit(
    problem: Problem, family: Family, p: Array, prior: Array, anchor: Array, worth_px: float, steps: int
) -> tuple[Array, Nodes, Array, Array, Array, float]:
    """Twin of `tubesight.methods.solve.fit`."""
    p, nodes, residual, weight, jacobian, root = levenberg_marquardt(
        problem, family.kind, family.count, p.copy(), prior, anchor, worth_px, steps
    )
    return p, Nodes(*nodes), residual, weight, jacobian, root


@compiled
def levenberg_marquardt(
    problem: Problem, kind: int, count: int, p: Array, prior: Array, anchor: Array, worth_px: float, steps: int
) -> tuple[Array, NodeArrays, Array, Array, Array, float]:
    """Loop of `fit`, which overwrites `p`; each step is tried in a second set of arrays."""
    n, size = len(problem.place), len(p)
    chain = empty_chain(count)
    nodes, other_nodes = empty_nodes(count), empty_nodes(count)
    miss, other_miss, residual, other_residual = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    jacobian, other_jacobian = np.empty((n, size)), np.empty((n, size))
    end, other_end = np.empty(size), np.empty(size)
    a, weight = np.empty(n), np.empty(n)
    factors = np.empty((len(problem.focal_px), NUISANCES, NUISANCES))
    hessian, gradient = np.empty((size, size)), np.empty(size)
    near, there = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        near[i] = int(problem.place[i] * INTERVALS + 0.5)
    end_off = try_step(problem, kind, count, p, chain, nodes, near, miss, jacobian, end)
    weights(problem, miss, weight)
    damping = DAMPING
    for _ in range(steps):
        shift_factors(problem, weight, a, factors)
        cost = without_shifts(problem, miss, a, factors, residual) + end_off * end_off + pull(anchor, p)
        for q in range(size):
            gradient[q] = end[q] * end_off + anchor[q] * p[q]
            for r in range(size):
                hessian[q, r] = end[q] * end[r]
            hessian[q, q] += prior[q]
        normal_equations(problem, jacobian, residual, a, factors, hessian, gradient)
        better = False
        for _ in range(8):
            trial = stepped(p, hessian, gradient, damping, count)
            if trial[count - 1] > SHORTEST * p[count - 1]:
                for i in range(n):
                    there[i] = near[i]
                trial_end = try_step(
                    problem, kind, count, trial, chain, other_nodes, there, other_miss, other_jacobian, other_end
                )
                trial_cost = without_shifts(problem, other_miss, a, factors, other_residual)
                trial_cost += trial_end * trial_end + pull(anchor, trial)
                if trial_cost <= cost * (1 + 1e-9):
                    better = True
                    break
            damping *= 6.0
        if not better:
            break
        moved = movement(nodes, other_nodes)
        end_off, damping = trial_end, max(damping / 10, 1e-9)
        for q in range(size):
            p[q], end[q] = trial[q], other_end[q]
        for i in range(n):
            near[i], miss[i] = there[i], other_miss[i]
            for q in range(size):
                jacobian[i, q] = other_jacobian[i, q]
        keep(other_nodes, nodes)
        weights(problem, other_residual, weight)
        if moved < CONVERGED_MM or (trial_cost > SLOW * cost and rms(problem, other_residual) > worth_px):
            break
    shift_factors(problem, weight, a, factors)
    without_shifts(problem, miss, a, factors, residual)
    return p, nodes, residual, weight, jacobian, rms(problem, residual)


@compiled
def keep(there: NodeArrays, nodes: NodeArrays) -> None:
    """Copy a curve that was tried over the current one."""
    size = nodes[6].shape[1]
    for i in range(INTERVALS + 1):
        nodes[3][i] = there[3][i]
        for q in range(size):
            nodes[6][i, q] = there[6][i, q]
        for c in range(3):
            nodes[0][i, c], nodes[1][i, c], nodes[2][i, c] = there[0][i, c], there[1][i, c], there[2][i, c]
            for q in range(size):
                nodes[4][i, c, q], nodes[5][i, c, q] = there[4][i, c, q], there[5][i, c, q]


@compiled
def pull(anchor: Array, p: Array) -> float:
    """Cost of parameters that are expected to be 0."""
    cost = 0.0
    for q in range(len(p)):
        cost += anchor[q] * p[q] * p[q]
    return cost


@compiled
def movement(nodes: NodeArrays, there: NodeArrays) -> float:
    """Twin of `tubesight.methods.solve.movement`."""
    largest = 0.0
    for i in range(INTERVALS + 1):
        along, square = 0.0, 0.0
        for c in range(3):
            off = there[0][i, c] - nodes[0][i, c]
            along += off * nodes[1][i, c]
            square += off * off
        square -= along * along if i < INTERVALS else 0.0
        largest = square if square > largest else largest
    return np.sqrt(largest)  # type: ignore[no-any-return]


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


@compiled
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


@compiled
def add_square(vector: Array, factor_: float, matrix: Array) -> None:
    """Add a vector's outer product with itself to a matrix."""
    for q in range(len(vector)):
        x = factor_ * vector[q]
        for r in range(len(vector)):
            matrix[q, r] += x * vector[r]
