"""Compiled twins of the parts of `tubesight.methods.solve`: same names, same numbers."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Indices
from tubesight.core.kernels import part
from tubesight.geometry.families import INTERVALS
from tubesight.methods.curve_kernels import ChainArrays, NodeArrays, nodes_of
from tubesight.methods.rays import BIAS_PX, ROWS, Problem
from tubesight.methods.solve import (
    MODEL_SD_PX,
    NUISANCES,
    RMS_CAP_PX,
    ROUGH_PX,
    STEP_MAX,
    TUKEY,
)


@part
def misses(problem: Problem, nodes: NodeArrays, p: Array, near: Indices, miss: Array, jacobian: Array) -> None:
    """Twin of `tubesight.methods.solve.misses`; writes `miss`, `jacobian` and the nearest nodes into `near`."""
    points, tangents, curvature, s, d_points, _, _ = nodes
    size = d_points.shape[2]
    spacing = s[INTERVALS] / INTERVALS
    open_radius = p[size] if problem.radius_open else 0.0
    for row in range(len(problem.row_sd_px)):
        view, tip = row // ROWS, row % ROWS == ROWS - 1
        ball = tip and np.isfinite(problem.tip_radius_mm)
        radius = problem.tip_radius_mm if ball else problem.radius_mm + open_radius
        cx, cy, cz = problem.centre_mm[view, 0], problem.centre_mm[view, 1], problem.centre_mm[view, 2]
        for i in range(problem.row_start[row], problem.row_start[row + 1]):
            dx, dy, dz = problem.direction[i, 0], problem.direction[i, 1], problem.direction[i, 2]
            best = INTERVALS if tip else descend(points, cx, cy, cz, dx, dy, dz, near[i])
            near[i] = best
            x, y, z = points[best, 0] - cx, points[best, 1] - cy, points[best, 2] - cz
            depth = x * dx + y * dy + z * dz
            x, y, z = x - depth * dx, y - depth * dy, z - depth * dz
            shift = 0.0
            if not tip:
                tx, ty, tz = tangents[best, 0], tangents[best, 1], tangents[best, 2]
                along = tx * dx + ty * dy + tz * dz
                tx, ty, tz = tx - along * dx, ty - along * dy, tz - along * dz
                kx, ky, kz = curvature[best, 0], curvature[best, 1], curvature[best, 2]
                along = kx * dx + ky * dy + kz * dz
                kx, ky, kz = kx - along * dx, ky - along * dy, kz - along * dz
                bottom = tx * tx + ty * ty + tz * tz + x * kx + y * ky + z * kz
                if abs(bottom) > 1e-6:
                    low, high = -spacing if best > 0 else 0.0, spacing if best < INTERVALS else 0.0
                    shift = min(max(-(x * tx + y * ty + z * tz) / bottom, low), high)
                square = shift * shift / 2
                x, y, z = x + tx * shift + kx * square, y + ty * shift + ky * square, z + tz * shift + kz * square
            distance = np.sqrt(x * x + y * y + z * z)
            if tip:
                ax, ay, az = problem.tip_axis[view, 0], problem.tip_axis[view, 1], problem.tip_axis[view, 2]
                along = dx * ax + dy * ay + dz * az
                if x * (dx - along * ax) + y * (dy - along * ay) + z * (dz - along * az) > 0:
                    distance = -distance
            to_px = problem.focal_px[view] / depth
            miss[i] = (distance - radius) * to_px
            x, y, z = x * to_px / distance, y * to_px / distance, z * to_px / distance
            share = abs(shift) / spacing
            other = best + (1 if shift > 0 else (-1 if shift < 0 else 0))
            for q in range(size):
                jacobian[i, q] = (1 - share) * (
                    x * d_points[best, 0, q] + y * d_points[best, 1, q] + z * d_points[best, 2, q]
                ) + share * (x * d_points[other, 0, q] + y * d_points[other, 1, q] + z * d_points[other, 2, q])
            if problem.radius_open:
                jacobian[i, size] = 0.0 if ball else -to_px


@part
def descend(points: Array, cx: float, cy: float, cz: float, dx: float, dy: float, dz: float, near: int) -> int:
    """Nearest node of a ray from (cx, cy, cz) along (dx, dy, dz), by walking downhill from a node."""
    last = len(points) - 1
    best, low, step = near, np.inf, 1
    for at in (near, near + 1):
        x, y, z = points[min(at, last), 0] - cx, points[min(at, last), 1] - cy, points[min(at, last), 2] - cz
        along = x * dx + y * dy + z * dz
        square = x * x + y * y + z * z - along * along
        if at > near and not square < low:
            step = -1
        elif square < low:
            best, low = min(at, last), square
    while 0 <= best + step <= last:
        x, y, z = points[best + step, 0] - cx, points[best + step, 1] - cy, points[best + step, 2] - cz
        along = x * dx + y * dy + z * dz
        square = x * x + y * y + z * z - along * along
        if not square < low:
            break
        best, low = best + step, square
    return best


@part
def end_miss(problem: Problem, nodes: NodeArrays, jacobian: Array) -> float:
    """Twin of `tubesight.methods.solve.end_miss`; writes the derivatives into `jacobian`."""
    for q in range(len(jacobian)):
        jacobian[q] = 0.0
    if np.isnan(problem.end_mm[0]):
        return 0.0
    points, tangents, d_points = nodes[0], nodes[1], nodes[4]
    miss = 0.0
    for c in range(3):
        miss += (points[INTERVALS, c] - problem.end_mm[c]) * tangents[INTERVALS, c] / problem.end_sd_mm
        for q in range(d_points.shape[2]):
            jacobian[q] += d_points[INTERVALS, c, q] * tangents[INTERVALS, c] / problem.end_sd_mm
    return miss


@part
def median_size(values: Array, low: int, high: int) -> float:
    """Median of the absolute values from `low` to before `high`, by sorting them into place."""
    count = high - low
    ordered = np.empty(count)
    for i in range(count):
        value, at = abs(values[low + i]), i
        while at > 0 and ordered[at - 1] > value:
            ordered[at] = ordered[at - 1]
            at -= 1
        ordered[at] = value
    return (ordered[(count - 1) // 2] + ordered[count // 2]) / 2  # type: ignore[no-any-return]


@part
def weights(problem: Problem, residual: Array, weight: Array) -> None:
    """Twin of `tubesight.methods.solve.weights`, written into `weight`."""
    for row in range(len(problem.row_sd_px)):
        low, high = problem.row_start[row], problem.row_start[row + 1]
        if high == low:
            continue
        sd = problem.row_sd_px[row]
        scale = max(1.4826 * median_size(residual, low, high), sd)
        for i in range(low, high):
            if scale > ROUGH_PX:
                off = residual[i] / (3 * scale + MODEL_SD_PX)
                weight[i] = sd * sd / (sd * sd + MODEL_SD_PX * MODEL_SD_PX) / (1 + off * off)
            else:
                left = 1 - (residual[i] / (TUKEY * scale)) ** 2
                weight[i] = left * left if not left < 0 else 0.0


@part
def factor(matrix: Array) -> None:
    """Cholesky factor of a positive definite matrix in its lower triangle, in place; NaN where it is none."""
    n = len(matrix)
    for j in range(n):
        for k in range(j):
            for i in range(j, n):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
        root = np.sqrt(matrix[j, j])
        for i in range(j, n):
            matrix[i, j] /= root


@part
def substitute(lower: Array, right: Array) -> None:
    """Solve ``L L^T X = B`` for the columns of B (n, K), in place."""
    n, columns = right.shape
    for i in range(n):
        for k in range(i):
            for q in range(columns):
                right[i, q] -= lower[i, k] * right[k, q]
        for q in range(columns):
            right[i, q] /= lower[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for q in range(columns):
                right[i, q] -= lower[k, i] * right[k, q]
        for q in range(columns):
            right[i, q] /= lower[i, i]


@part
def shift_factors(problem: Problem, weight: Array, a: Array, factors: Array) -> None:
    """Precisions `a` of the rays from their weights, and factors (V, K, K) of the normal equations of the shifts."""
    factors[:] = 0.0
    for row in range(len(problem.row_sd_px)):
        view, k = row // ROWS, 1 + 2 * (row % ROWS)
        matrix = factors[view]
        inverse = 1 / (problem.row_sd_px[row] * problem.row_sd_px[row])
        for i in range(problem.row_start[row], problem.row_start[row + 1]):
            a[i] = weight[i] * inverse
            u, v = problem.lobes[i]
            matrix[0, 0] += a[i]
            matrix[k, 0] += a[i] * u
            matrix[k + 1, 0] += a[i] * v
            matrix[k, k] += a[i] * u * u
            matrix[k + 1, k] += a[i] * u * v
            matrix[k + 1, k + 1] += a[i] * v * v
        prior = 1 / (problem.lobe_sd_px[row] * problem.lobe_sd_px[row])
        matrix[k, k] += prior
        matrix[k + 1, k + 1] += prior
    for view in range(len(problem.focal_px)):
        factors[view, 0, 0] += 1 / (BIAS_PX * BIAS_PX)
        factor(factors[view])


@part
def without_shifts(problem: Problem, miss: Array, a: Array, factors: Array, residual: Array) -> float:
    """Twin of `tubesight.methods.solve.without_shifts`, written into `residual`."""
    views = len(problem.focal_px)
    shift = np.zeros((views, NUISANCES, 1))
    for row in range(len(problem.row_sd_px)):
        s, k = shift[row // ROWS, :, 0], 1 + 2 * (row % ROWS)
        for i in range(problem.row_start[row], problem.row_start[row + 1]):
            s[0] += a[i] * miss[i]
            s[k] += a[i] * miss[i] * problem.lobes[i, 0]
            s[k + 1] += a[i] * miss[i] * problem.lobes[i, 1]
    cost = 0.0
    for view in range(views):
        substitute(factors[view], shift[view])
        cost += (shift[view, 0, 0] / BIAS_PX) ** 2
    for row in range(len(problem.row_sd_px)):
        s, k = shift[row // ROWS, :, 0], 1 + 2 * (row % ROWS)
        cost += (s[k] * s[k] + s[k + 1] * s[k + 1]) / (problem.lobe_sd_px[row] * problem.lobe_sd_px[row])
        for i in range(problem.row_start[row], problem.row_start[row + 1]):
            residual[i] = miss[i] - s[0] - problem.lobes[i, 0] * s[k] - problem.lobes[i, 1] * s[k + 1]
            cost += a[i] * residual[i] * residual[i]
    return cost


@part
def mixed_with_shifts(problem: Problem, jacobian: Array, a: Array, mixed: Array) -> None:
    """Write the mixed part (V, K, P) of the normal equations of shifts and parameters into `mixed`."""
    size = jacobian.shape[1]
    mixed[:] = 0.0
    for row in range(len(problem.row_sd_px)):
        k = 1 + 2 * (row % ROWS)
        every, one, two = mixed[row // ROWS, 0], mixed[row // ROWS, k], mixed[row // ROWS, k + 1]
        for i in range(problem.row_start[row], problem.row_start[row + 1]):
            u, v = problem.lobes[i, 0], problem.lobes[i, 1]
            for q in range(size):
                x = a[i] * jacobian[i, q]
                every[q] += x
                one[q] += u * x
                two[q] += v * x


@part
def normal_equations(
    problem: Problem, jacobian: Array, residual: Array, a: Array, factors: Array, hessian: Array, gradient: Array
) -> None:
    """Twin of `tubesight.methods.solve.normal_equations`; adds to `hessian` (its lower triangle) and `gradient`."""
    size = jacobian.shape[1]
    for i in range(len(a)):
        for q in range(size):
            x = a[i] * jacobian[i, q]
            gradient[q] += x * residual[i]
            for r in range(q + 1):
                hessian[q, r] += x * jacobian[i, r]
    views = len(problem.focal_px)
    mixed = np.empty((views, NUISANCES, size))
    mixed_with_shifts(problem, jacobian, a, mixed)
    for view in range(views):
        solved = mixed[view].copy()
        substitute(factors[view], solved)
        for k in range(NUISANCES):
            for q in range(size):
                for r in range(q + 1):
                    hessian[q, r] -= mixed[view, k, q] * solved[k, r]


@part
def rms(problem: Problem, residual: Array) -> float:
    """Twin of `tubesight.methods.solve.rms`."""
    total, most = 0.0, 0.0
    for row in range(len(problem.row_sd_px)):
        if row % ROWS < ROWS - 1:
            inverse = 1 / (problem.row_sd_px[row] * problem.row_sd_px[row])
            for i in range(problem.row_start[row], problem.row_start[row + 1]):
                r = abs(residual[i])
                r = RMS_CAP_PX if r > RMS_CAP_PX else r
                total += inverse * r * r
                most += inverse
    return np.sqrt(total / most)  # type: ignore[no-any-return]


@part
def try_step(
    problem: Problem,
    kind: int,
    count: int,
    p: Array,
    chain: ChainArrays,
    nodes: NodeArrays,
    near: Indices,
    miss: Array,
    jacobian: Array,
    end: Array,
) -> float:
    """Curve, misses and their derivatives for parameters, written into the arrays; returns the miss of a flat end."""
    nodes_of(kind, count, p, problem.start_rotation, problem.start_mm, chain, nodes)
    misses(problem, nodes, p, near, miss, jacobian)
    return end_miss(problem, nodes, end)


@part
def stepped(p: Array, hessian: Array, gradient: Array, damping: float, count: int, trial: Array) -> None:
    """Write the parameters (P,) after a Levenberg-Marquardt step, cut to `STEP_MAX`, into `trial`."""
    lower, step = hessian.copy(), np.empty((len(gradient), 1))
    for q in range(len(lower)):
        lower[q, q] *= 1 + damping
        step[q, 0] = gradient[q]
    factor(lower)
    substitute(lower, step)
    longest = 1e-9
    for q in range(count - 1):
        longest = max(longest, abs(step[q, 0]))
    for q in range(len(p)):
        trial[q] = p[q] - step[q, 0] * min(1.0, STEP_MAX / longest)
