"""Compiled twins of the loops of `tubesight.methods.solve`: `fit` and `sandwich`."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import compiled
from tubesight.geometry.families import INTERVALS, Family, Nodes
from tubesight.methods.curve_kernels import NodeArrays, empty_chain, empty_nodes
from tubesight.methods.kernels import (
    damped_step,
    factor,
    mixed_with_shifts,
    normal_equations,
    rms,
    shift_factors,
    substitute,
    try_step,
    weights,
    without_shifts,
)
from tubesight.methods.rays import BIAS_PX, ROWS, Problem
from tubesight.methods.solve import BLOCK_MM, CONVERGED_MM, DAMPING, NUISANCES, SHORTEST, SLOW, STEP_MAX


def fit(
    problem: Problem, family: Family, p: Array, prior: Array, anchor: Array, worth_px: float, steps: int
) -> tuple[Array, Nodes, Array, Array, Array, float]:
    """Twin of `tubesight.methods.solve.fit`."""
    p, nodes, residual, weight, jacobian, root = levenberg_marquardt(
        problem, family.kind, family.count, p, prior, anchor, worth_px, steps
    )
    return p, Nodes(*nodes), residual, weight, jacobian, root


@compiled
def levenberg_marquardt(
    problem: Problem, kind: int, count: int, p: Array, prior: Array, anchor: Array, worth_px: float, steps: int
) -> tuple[Array, NodeArrays, Array, Array, Array, float]:
    """Loop of `fit`; the last but one and the current state swap their arrays."""
    n, size = len(problem.place), len(p)
    chain = empty_chain(count)
    nodes, other_nodes = empty_nodes(count), empty_nodes(count)
    miss, other_miss, residual, other_residual = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    jacobian, other_jacobian = np.empty((n, size)), np.empty((n, size))
    end, other_end = np.empty(size), np.empty(size)
    a, weight = np.empty(n), np.empty(n)
    factors = np.empty((len(problem.focal_px), NUISANCES, NUISANCES))
    hessian, gradient = np.empty((size, size)), np.empty(size)
    near = np.floor(problem.place * INTERVALS + 0.5).astype(np.int64)
    end_off = try_step(problem, kind, count, p, chain, nodes, near, miss, jacobian, end)
    weights(problem, miss, weight)
    damping = DAMPING
    for _ in range(steps):
        shift_factors(problem, weight, a, factors)
        cost = without_shifts(problem, miss, a, factors, residual) + end_off * end_off + (anchor * p * p).sum()
        for q in range(size):
            gradient[q] = end[q] * end_off + anchor[q] * p[q]
            for r in range(size):
                hessian[q, r] = end[q] * end[r]
            hessian[q, q] += prior[q]
        normal_equations(problem, jacobian, residual, a, factors, hessian, gradient)
        better = False
        for _ in range(8):
            move = damped_step(hessian, gradient, damping)
            trial = p - move * min(1.0, STEP_MAX / max(np.abs(move[: count - 1]).max(), 1e-9))
            if trial[count - 1] > SHORTEST * p[count - 1]:
                there = near.copy()
                trial_end = try_step(
                    problem, kind, count, trial, chain, other_nodes, there, other_miss, other_jacobian, other_end
                )
                trial_cost = without_shifts(problem, other_miss, a, factors, other_residual)
                trial_cost += trial_end * trial_end + (anchor * trial * trial).sum()
                if trial_cost <= cost * (1 + 1e-9):
                    better = True
                    break
            damping *= 6.0
        if not better:
            break
        moved = movement(nodes, other_nodes)
        p, end_off, near, damping = trial, trial_end, there, max(damping / 10, 1e-9)
        nodes, other_nodes, miss, other_miss = other_nodes, nodes, other_miss, miss
        jacobian, other_jacobian, end, other_end = other_jacobian, jacobian, other_end, end
        weights(problem, other_residual, weight)
        if moved < CONVERGED_MM or (trial_cost > SLOW * cost and rms(problem, other_residual) > worth_px):
            break
    shift_factors(problem, weight, a, factors)
    without_shifts(problem, miss, a, factors, residual)
    return p, nodes, residual, weight, jacobian, rms(problem, residual)


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
    priors = known.copy()
    for view in range(views):
        substitute(factors[view], mixed[view])
        for k in range(NUISANCES):
            sd = BIAS_PX if k == 0 else problem.lobe_sd_px[ROWS * view + (k - 1) // 2]
            for q in range(size):
                for r in range(size):
                    priors[q, r] += mixed[view, k, q] * mixed[view, k, r] / (sd * sd)
    hessian = priors.copy()
    together, independent = np.zeros((size, size)), np.zeros((size, size))
    blocks = gradients(problem, jacobian, residual, a, mixed, length_mm, hessian, together, independent)
    together *= blocks / max(blocks - count, 1)
    factor(hessian)
    inverse = np.eye(size)
    substitute(hessian, inverse)
    middle = priors
    if (inverse * together).sum() > (inverse * independent).sum():
        middle += together
    else:
        middle += independent
    return inverse @ middle @ inverse


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
                total[:] = 0.0
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
