"""Nonlinear least squares of a curve on the silhouette: edge rays, tip and clamp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from tubesight.core import Array, Mask, Tube, readonly
from tubesight.geometry.families import Family, Nodes
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.vision.view import View

# What a clamp is trusted to: place and direction of the base (standard deviations).
_CLAMP_MM, _CLAMP_RAD = 0.05, np.radians(0.05)
# How well the middle of a flat end face is known along the tube.
_END_SD_MM = 0.02
# A guess of the radius from the pictures is good to this share.
_RADIUS_SHARE = 0.2
# Edges may all lie this far outwards or inwards in one view (blur, gamma), and each row of them this far by itself
# (limb shading), plus a share of its roughness: what roughens an edge also moves it.
_BIAS_PX = 0.2
_ROW_PX, _ROW_SHARE = 0.04, 0.7
# Steps of the differences of the curve's nodes by its parameters: angles in rad, lengths in mm.
_STEP = 1e-6
_ITERATIONS = 30
# Edges farther off than this many robust deviations carry no weight (Tukey's biweight: 4.7 for 95 % efficiency).
_TUKEY = 4.7
_SCALE_FLOOR_PX = 0.03
# No edge counts with more than this in the rms that families are compared by: what crosses the tube is not its shape.
_RMS_CAP_PX = 3.0
# Inverse variance that keeps what the data do not determine (the azimuth of a straight tube) from making the equations
# singular: a radian and a millimetre weigh less than a thousandth of one edge.
_RIDGE = 1e-6
# Inverse variance of what is known: a millionth of a millimetre.
_FIXED = 1e12
# Numbers of the base's own parameters (x, y in mm, tilts about y and -x in rad) before the biases of the views.
BASE = 4


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Silhouette rays of all views in the base frame.

    Attributes
    ----------
    origin, direction
        (N, 3) centre of projection and unit direction of each ray.
    focal_px
        (N,) to turn angles into pixels.
    view, side
        (N,) index of the view and of the row of edges (left, right, tip) it belongs to.
    sd_px
        (N,) roughness of its row.
    lobes
        (N, 2) the two ways in which shading moves a row: sides shift and tilt along the tube; a ball's contour shifts
        as a whole in the picture, along both axes.
    row_sd_px
        (R,) how far each row may be moved so.
    place
        (N,) share of the way from base to tip in its view; 1 for rays of the tip.
    tip
        (N,) whether it touches the tip instead of the tube.
    """

    origin: Array
    direction: Array
    focal_px: Array
    view: np.ndarray[tuple[int], np.dtype[np.intp]]
    side: np.ndarray[tuple[int], np.dtype[np.intp]]
    sd_px: Array
    place: Array
    tip: Mask
    lobes: Array
    row_sd_px: Array


def collect(views: Mapping[str, View], rig: Rig, tube: Tube) -> Rays:
    """Gather the edge rays of all views and the rays of ball and rounded tips."""
    parts = []
    row_sd = []
    for index, (name, view) in enumerate(views.items()):
        centre = rig.centre_mm(name)
        chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(view.centreline_px, axis=0), axis=1))])
        before = float(np.linalg.norm(view.tip.px - view.centreline_px[-1]))
        share = chord / (chord[-1] + before)
        doubt = [*view.edge_doubt_px, view.tip.doubt_px]
        rough = [*view.edge_sd_px, view.tip.rms_px]
        row_sd += [np.hypot(_ROW_PX, d + _ROW_SHARE * r) for d, r in zip(doubt, rough, strict=True)]
        sides = np.stack([np.ones(len(share)), 2 * share - 1], 1)
        rows = [(view.edge_rays[:, k], share, view.edge_sd_px[k], False, sides) for k in (0, 1)]
        if tube.tip.shape != "flat":
            contour = rig.cameras[name].unproject(view.tip.contour_px)
            sd = max(view.tip.rms_px, float(view.edge_sd_px.mean()))
            outward = view.tip.contour_px - view.tip.px
            outward = outward / np.linalg.norm(outward, axis=1, keepdims=True)
            rows.append((contour, np.ones(len(contour)), sd, True, outward))
        for k, (rays, place, sd, is_tip, lobes) in enumerate(rows):
            n = len(rays)
            parts.append(
                (
                    np.broadcast_to(centre, (n, 3)),
                    rig.directions(name, rays),
                    np.full(n, rig.cameras[name].focal_px),
                    np.full(n, index),
                    np.full(n, 3 * index + k),
                    np.full(n, sd),
                    place,
                    np.full(n, is_tip),
                    lobes,
                )
            )
    origin, direction, focal, view_index, side, rough_px, place, tip, lobes = (
        np.concatenate(p) for p in zip(*parts, strict=True)
    )
    return Rays(origin, direction, focal, view_index, side, rough_px, place, tip, lobes, np.array(row_sd))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fitted curve.

    Attributes
    ----------
    family
        Which.
    parameters
        Of the family, then base (4), then the bias of each view, two lobes of each row (px), then the correction of
        the radius (mm).
    nodes
        The curve in the base frame (a batch of one).
    residual_px
        (N,) edges' distances outwards from the model.
    weight
        (N,) robust weights, 0 to 1.
    rms_px
        Weighted root mean square of the edges of the tube.
    jacobian
        (N, P)
    """

    family: Family
    parameters: Array
    nodes: Nodes
    residual_px: Array
    weight: Array
    rms_px: float
    jacobian: Array

    def residual_at(self, problem: Problem, rays: Rays) -> Array:
        """Residuals (N,) of other rays of the same edges, at the same parameters."""
        return _evaluate(replace(problem, rays=rays), self.family, self.parameters, None)[0]


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Everything a fit needs but the family and its first guess.

    Attributes
    ----------
    rays
        The data.
    start
        ``base_from_start``: where the curve starts; the identity for a clamp.
    radius_mm
        Radius of the tube, or a first guess of it.
    tip_radius_mm
        Radius of a ball; None where the tip has the tube's own radius.
    radius_known
        Whether `radius_mm` is exact or a guess to be improved.
    clamped
        Whether the start is known (`_CLAMP_MM`, `_CLAMP_RAD`) or free.
    views
        Number of views.
    end_mm
        For flat tips: the middle of the end face.
    """

    rays: Rays
    start: Pose
    radius_mm: float
    tip_radius_mm: float | None
    radius_known: bool
    clamped: bool
    views: int
    end_mm: Array | None = None

    def __post_init__(self) -> None:
        if self.end_mm is not None:
            object.__setattr__(self, "end_mm", readonly(self.end_mm, (3,), "end_mm"))


def fit_family(problem: Problem, family: Family, guess: Array) -> Fit:
    """Fit one family from a first guess of its parameters.

    Minimises the robust sum of squared pixels of ``(distance of ray to centreline - radius) focal / range - bias of
    the view`` with priors on clamp and bias, by Levenberg-Marquardt steps with reweighting. The distance's derivative
    by a parameter is the unit normal times the derivative of the nearest point: at the nearest point its place does
    not matter.
    """
    count = family.count
    p = np.concatenate([guess, np.zeros(BASE + 7 * problem.views + 1)])
    near: Array | None = None
    damping = 1e-3
    state = _evaluate(problem, family, p, near)
    weight = _weights(problem, state[0], first=True)
    cost = _cost(problem, family, p, state[0], weight)
    for step in range(_ITERATIONS):
        residual, jacobian, near = state[0], state[1], state[2]
        w = weight / variances(problem, residual)
        normal = jacobian.T @ (jacobian * w[:, None]) + np.diag(prior(problem, family, len(p)))
        gradient = jacobian.T @ (residual * w) + _anchored(problem, family, p)
        for _ in range(8):
            delta = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
            trial = p + delta
            if trial[count - 1] > 0.3 * p[count - 1]:
                tried = _evaluate(problem, family, trial, near)
                trial_cost = _cost(problem, family, trial, tried[0], weight)
                if np.isfinite(trial_cost) and trial_cost <= cost * (1 + 1e-9):
                    break
            damping *= 6.0
        else:
            break
        moved = float(np.abs(state[3].points[0] - tried[3].points[0]).max())
        p, state, damping = trial, tried, max(damping / 10, 1e-9)
        weight = _weights(problem, state[0], first=moved > 1.0)
        cost = _cost(problem, family, p, state[0], weight)
        if moved < 1e-4 and step > 1:
            break
    residual, jacobian, _, nodes = state
    return Fit(family, p, nodes, residual, weight, _rms(problem.rays, residual), jacobian)


def _rms(rays: Rays, residual: Array) -> float:
    """Root mean square of the tube's edges: rows count by their smoothness, and no edge more than `_RMS_CAP_PX`."""
    used = ~rays.tip
    r = np.minimum(np.abs(residual[: len(used)][used]), _RMS_CAP_PX)
    inverse = rays.sd_px[used] ** -2
    return float(np.sqrt((inverse * r * r).sum() / inverse.sum()))


def variances(problem: Problem, residual: Array) -> Array:
    """Variance (N,) of each residual, px^2: its row's roughness; 1 for the end face, which is already scaled."""
    return np.append(problem.rays.sd_px**2, np.ones(len(residual) - len(problem.rays.sd_px)))


def prior(problem: Problem, family: Family, size: int) -> Array:
    """Inverse variances of what is expected to be 0: open parameters of the family, base, biases, radius."""
    count = family.count
    weight = np.full(size, _RIDGE)
    for index, sd in family.soft:
        weight[index] = sd**-2
    if problem.clamped:
        weight[count : count + 2], weight[count + 2 : count + 4] = _CLAMP_MM**-2, _CLAMP_RAD**-2
    else:
        weight[count : count + 4] = _RIDGE
    weight[count + BASE : count + BASE + problem.views] = _BIAS_PX**-2
    weight[count + BASE + problem.views : -1] = np.repeat(problem.rays.row_sd_px, 2) ** -2
    weight[-1] = _FIXED if problem.radius_known else (_RADIUS_SHARE * problem.radius_mm) ** -2
    return weight


def _anchored(problem: Problem, family: Family, p: Array) -> Array:
    """Gradient of the priors; the ridge of the family's other parameters pulls them nowhere."""
    gradient = prior(problem, family, len(p)) * p
    held = {index for index, _ in family.soft}
    gradient[[k for k in range(family.count) if k not in held]] = 0.0
    return gradient


def _cost(problem: Problem, family: Family, p: Array, residual: Array, weight: Array) -> float:
    return float(
        (weight * residual**2 / variances(problem, residual)).sum() + (_anchored(problem, family, p) * p).sum()
    )


def _weights(problem: Problem, residual: Array, first: bool) -> Array:
    """Tukey's biweight by rows; on the way from a rough guess everything counts, the farthest less (Cauchy)."""
    n = len(problem.rays.place)
    weight = np.ones(len(residual))
    for row in np.unique(problem.rays.side):
        mask = np.flatnonzero(problem.rays.side == row)
        r = residual[:n][mask]
        scale = max(1.4826 * float(np.median(np.abs(r))), _SCALE_FLOOR_PX)
        if first:
            weight[mask] = 1 / (1 + (r / (3 * scale + 1.0)) ** 2)
        else:
            scale = max(scale, float(problem.rays.sd_px[mask[0]]))
            weight[mask] = np.clip(1 - (r / (_TUKEY * scale)) ** 2, 0, None) ** 2
    return weight


def curve_of(problem: Problem, family: Family, parameters: Array) -> Nodes:
    """Nodes of a batch of parameter vectors in the base frame, base offsets and tilts applied."""
    count = family.count
    local = family.nodes(parameters[:, :count])
    offset = np.concatenate([parameters[:, count : count + 2], np.zeros((len(parameters), 1))], 1)
    tilt = parameters[:, count + 2 : count + 4]
    rotation = np.broadcast_to(np.eye(3), (len(parameters), 3, 3)).copy()
    rotation[:, 0, 2], rotation[:, 1, 2] = tilt[:, 0], tilt[:, 1]
    rotation[:, 2, 0], rotation[:, 2, 1] = -tilt[:, 0], -tilt[:, 1]
    turn = problem.start.rotation @ rotation

    def rotate(vectors: Array) -> Array:
        return np.asarray(vectors @ turn.transpose(0, 2, 1))

    start = problem.start.translation_mm + offset @ problem.start.rotation.T
    return Nodes(rotate(local.points) + start[:, None], rotate(local.tangents), rotate(local.curvature), local.s_mm)


def _evaluate(problem: Problem, family: Family, p: Array, near: Array | None) -> tuple[Array, Array, Array, Nodes]:
    """Residuals (N,), Jacobian (N, P), places of the nearest nodes (N,) and the curve."""
    geometric = family.count + BASE
    steps = np.full(geometric, _STEP)
    steps[family.count - 1] = steps[family.count] = steps[family.count + 1] = 1e-4
    batch = np.concatenate([p[None], p + np.eye(len(p))[:geometric] * steps[:, None]])
    nodes = curve_of(problem, family, batch)
    slope = (nodes.points[1:] - nodes.points[:1]) / steps[:, None, None]
    rays = problem.rays
    size = len(rays.place)
    points, tangents, curvature = nodes.points[0], nodes.tangents[0], nodes.curvature[0]
    last = len(points) - 1
    relative = points[None] - rays.origin[:, None]
    along = np.einsum("nmk,nk->nm", relative, rays.direction)
    squared = (relative**2).sum(-1) - along**2
    expected = rays.place * last if near is None else near
    window = 0.25 * last if near is None else 0.1 * last
    allowed = np.abs(np.arange(last + 1) - expected[:, None]) <= window
    best = np.where(rays.tip, last, np.where(allowed, squared, np.inf).argmin(1))
    rows = np.arange(size)
    w = relative[rows, best] - along[rows, best, None] * rays.direction
    t = tangents[best] - (tangents[best] * rays.direction).sum(1, keepdims=True) * rays.direction
    k = curvature[best] - (curvature[best] * rays.direction).sum(1, keepdims=True) * rays.direction
    bottom = (t * t).sum(1) + (w * k).sum(1)
    spacing = nodes.s_mm[0, -1] / last
    shift = np.clip(-(w * t).sum(1) / np.where(np.abs(bottom) > 1e-6, bottom, np.inf), -spacing, spacing)
    shift = np.where(rays.tip, 0.0, shift)
    shift = np.where(((best == 0) & (shift < 0)) | ((best == last) & (shift > 0)), 0.0, shift)
    miss = w + t * shift[:, None] + k * (shift**2 / 2)[:, None]
    distance = np.linalg.norm(miss, axis=1)
    normal = miss / distance[:, None]
    to_px = rays.focal_px / along[rows, best]
    tube = problem.radius_mm + p[-1]
    row = geometric + problem.views + 2 * rays.side
    radius = np.where(rays.tip & (problem.tip_radius_mm is not None), problem.tip_radius_mm or 0.0, tube)
    residual = (distance - radius) * to_px - p[geometric + rays.view]
    residual -= rays.lobes[:, 0] * p[row] + rays.lobes[:, 1] * p[row + 1]
    fraction = np.clip(shift / spacing, -1, 1)
    other = np.clip(best + np.sign(fraction).astype(int), 0, last)
    share = np.abs(fraction)[:, None]
    moved = slope[:, best] * (1 - share) + slope[:, other] * share
    jacobian = np.zeros((size, len(p)))
    jacobian[:, :geometric] = np.einsum("pnk,nk->np", moved, normal) * to_px[:, None]
    jacobian[rows, geometric + rays.view] = -1.0
    jacobian[rows, row] = -rays.lobes[:, 0]
    jacobian[rows, row + 1] = -rays.lobes[:, 1]
    jacobian[:, -1] = np.where(rays.tip & (problem.tip_radius_mm is not None), 0.0, -to_px)
    if problem.end_mm is not None:
        heading = tangents[-1]
        residual = np.append(residual, (points[-1] - problem.end_mm) @ heading / _END_SD_MM)
        end = np.zeros(len(p))
        end[:geometric] = slope[:, -1] @ heading / _END_SD_MM
        jacobian = np.vstack([jacobian, end])
    return residual, jacobian, best + fraction, nodes
