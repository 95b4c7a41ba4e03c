"""How far a fitted curve may be off: from the pictures, and from the calibration."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Status, Unmeasurable
from tubesight.geometry.curve import NodeCurve
from tubesight.methods.fit import BASE, Fit, Problem, Rays, curve_of, prior, variances

# Residuals along one edge hang together over about this length of tube.
_BLOCK_MM = 25.0
# Displaced curves are taken at this share of a deviation and scaled up: the map from parameters to numbers is linear
# there.
_SHARE = 0.05


def bread(problem: Problem, fit: Fit) -> Array:
    """Inverse normal matrix (P, P) of the weighted fit with its priors."""
    weight = fit.weight / variances(problem, fit.residual_px)
    normal = fit.jacobian.T @ (fit.jacobian * weight[:, None])
    normal += np.diag(prior(problem, fit.family, len(fit.parameters)))
    return np.asarray(np.linalg.pinv(normal, hermitian=True))


def picture_covariance(problem: Problem, fit: Fit) -> Array:
    """Covariance (P, P) of the parameters from the edges.

    Sandwich estimator ``H^-1 M H^-1``: M sums the gradients of blocks of one edge over `_BLOCK_MM` of tube, so that
    correlated residuals count as often as they are independent, and adds the priors, among them the shift of each row.
    Blocks are corrected for the freedom the fit took.
    """
    rays = problem.rays
    inverse = bread(problem, fit)
    weight = fit.weight / variances(problem, fit.residual_px)
    gradient = fit.jacobian * (weight * fit.residual_px)[:, None]
    n = len(rays.place)
    blocks = np.floor(rays.place * max(float(fit.nodes.s_mm[0, -1]) / _BLOCK_MM, 1.0))
    key = rays.side * 1000 + np.where(rays.tip, 999, np.minimum(blocks, 998)).astype(int)
    middle = np.zeros_like(inverse)
    labels = np.unique(key)
    for label in labels:
        total = gradient[:n][key == label].sum(0)
        middle += np.outer(total, total)
    independent = (gradient[:, :, None] * gradient[:, None, :]).sum(0)
    freedom = len(labels) / max(len(labels) - fit.family.count, 1)
    middle = np.where(np.trace(inverse @ middle) > np.trace(inverse @ independent), middle * freedom, independent)
    middle += np.diag(prior(problem, fit.family, len(fit.parameters)))
    return np.asarray(inverse @ middle @ inverse)


def rig_covariance(problem: Problem, fit: Fit, moved: list[Rays], steps: Array, covariance: Array) -> Array:
    """Covariance (P, P) of the parameters from the calibration: ``G S G^T``, ``G = -H^-1 J^T W J_c``.

    Parameters
    ----------
    moved, steps
        The rays with each calibrated parameter moved by its step, (K,).
    covariance
        (K, K) of the calibrated parameters.
    """
    inverse = bread(problem, fit)
    weight = fit.weight / variances(problem, fit.residual_px)
    columns = []
    for rays, step in zip(moved, steps, strict=True):
        residual = fit.residual_at(problem, rays)
        columns.append((residual - fit.residual_px) / step)
    g = -inverse @ (fit.jacobian * weight[:, None]).T @ np.stack(columns, 1)
    return np.asarray(g @ covariance @ g.T)


def displaced(problem: Problem, fit: Fit, covariance: Array) -> tuple[NodeCurve, ...]:
    """Curves one deviation away along each independent direction of a covariance of the parameters.

    Raises
    ------
    Unmeasurable
        If a deviation is so large that the curve is not determined.
    """
    geometric = fit.family.count + BASE
    values, vectors = np.linalg.eigh(covariance[:geometric, :geometric])
    factor = vectors * np.sqrt(np.clip(values, 0.0, None))
    moved = np.repeat(fit.parameters[None], geometric, axis=0)
    moved[:, :geometric] += _SHARE * factor.T
    nodes = curve_of(problem, fit.family, moved)
    s, points, tangents = (
        (still[0] + (there - still[0]) / _SHARE)
        for still, there in (
            (fit.nodes.s_mm, nodes.s_mm),
            (fit.nodes.points, nodes.points),
            (fit.nodes.tangents, nodes.tangents),
        )
    )
    if not (np.diff(s, axis=1) > 0).all():
        raise Unmeasurable(Status.NEAR_DEGENERATE, detail="the pictures leave the length of the curve open")
    return tuple(NodeCurve(fit.family.name, s[k], points[k], tangents[k]) for k in range(geometric))
