"""The cone over a conic and the rays of another camera: every root, then the choice of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Mask
from tubesight.geometry.conic import Conic
from tubesight.geometry.pose import Pose

# A discriminant below zero by less than this share of L2^2 + |4 L1 L3| is a tangent ray: the square root of float64's
# rounding, so that exact data lose no ray.
_TANGENT = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Where rays meet a cone.

    Attributes
    ----------
    depths_mm
        (N, 2) depths r along ``v = (x, y, 1)``, ascending where both are finite; NaN where there is no root.
    valid
        (N, 2): the root exists and its point lies in front of both cameras.
    tangent
        (N,): both roots coincide up to rounding, or the ray misses the cone by no more than rounding.
    """

    depths_mm: Array
    valid: Mask
    tangent: Mask


@dataclass(frozen=True, slots=True, eq=False)
class Cone:
    """Cone whose apex is a camera and which passes through a conic of its image plane."""

    conic: Conic

    def intersect(self, cone_from_ray: Pose, rays: Array) -> Hits:
        """Intersect the rays ``r v`` of another camera with this cone.

        Solves ``L1 r^2 + L2 r + L3 = 0`` with ``L1 = (Rv)^T C (Rv)``, ``L2 = 2 t^T C (Rv)``, ``L3 = t^T C t``
        (equations 6 to 9 of Dalvand et al. 2016), in the conic's principal frame and by the form of the quadratic formula
        that does not cancel; a double line gives the single meeting point with its plane, twice.

        Parameters
        ----------
        cone_from_ray
            Pose of the rays' camera in the cone's camera, ``x_i = R x_j + t``.
        rays
            (N, 3) rays ``v = (x, y, 1)``.
        """
        a = rays @ (self.conic.frame @ cone_from_ray.rotation).T
        b = self.conic.frame @ cone_from_ray.translation_mm
        if self.conic.kind == "line":
            values, vectors = np.linalg.eigh(self.conic.normal)
            normal = vectors[:, int(np.argmax(np.abs(values)))]
            with np.errstate(divide="ignore", invalid="ignore"):
                single = -(b @ normal) / (a @ normal)
            depths = np.stack([single, single], -1)
            tangent = np.ones(len(a), dtype=bool)
        else:
            depths, tangent = _roots(
                np.einsum("ni,ij,nj->n", a, self.conic.normal, a), 2 * a @ self.conic.normal @ b, b @ self.conic.normal @ b
            )
        depths = np.where(np.isfinite(depths), depths, np.nan)
        other = rays[:, None, :] * depths[..., None] @ cone_from_ray.rotation.T + cone_from_ray.translation_mm
        return Hits(depths, np.asarray((depths > 0) & (other[..., 2] > 0)), tangent & np.isfinite(depths[:, 0]))


def _roots(l1: Array, l2: Array, l3: float) -> tuple[Array, Mask]:
    """Both roots (N, 2), ascending, of ``l1 r^2 + l2 r + l3``, and which are double."""
    discriminant = l2 * l2 - 4 * l1 * l3
    size = l2 * l2 + np.abs(4 * l1 * l3)
    tangent = np.abs(discriminant) <= _TANGENT * size
    root = np.sqrt(np.where(discriminant > 0, discriminant, np.where(tangent, 0.0, np.nan)))
    q = -(l2 + np.where(l2 >= 0, root, -root)) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.stack([q / l1, l3 / q], -1)
    return np.sort(both, axis=-1), tangent


def nearest_depth(hits: Hits, base_depth_mm: float) -> Array:
    """Choose per ray the depth nearest that of the base point (equation 10 of Dalvand et al. 2016).

    It picks wrong roots on strongly bent tubes; `ordered_depths` does not. Kept as the paper's rule.

    Returns
    -------
    Array
        (N,) depths; NaN where no root is valid.
    """
    distance = np.where(hits.valid, np.abs(hits.depths_mm - base_depth_mm), np.inf)
    chosen = hits.depths_mm[np.arange(len(distance)), distance.argmin(1)]
    return np.where(np.isfinite(distance.min(1)), chosen, np.nan)


def ordered_depths(hits: Hits, cone_from_ray: Pose, rays: Array, arc_xy: Array, tolerance: float) -> Array:
    """Choose the roots whose reprojections run along the observed arc of the cone's view, in order.

    Each root is carried to the cone's image plane and there to its place along the observed arc. The chain of roots of least
    cost is found by dynamic programming; the cost is the distance off the arc, beyond its ends included, and any
    step backwards along it, both in units of `tolerance`.

    Parameters
    ----------
    hits
        Roots of the rays in the order in which they follow the tube.
    cone_from_ray
        Pose of the rays' camera in the cone's camera.
    rays
        (N, 3)
    arc_xy
        (M, 2) observed centreline on the cone's ideal image plane, in order from the base.
    tolerance
        What counts as off the arc, in units of the image plane.

    Returns
    -------
    Array
        (N,) depths; NaN where no root is valid or the chosen one lies off the arc by more than `tolerance`.
    """
    points = (rays[:, None, :] * hits.depths_mm[..., None]) @ cone_from_ray.rotation.T + cone_from_ray.translation_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = points[..., :2] / points[..., 2:]
    xy = np.where(hits.valid[..., None], xy, np.nan)
    place, off = place_along(arc_xy, xy.reshape(-1, 2))
    place, off = place.reshape(-1, 2), off.reshape(-1, 2)
    node = np.where(hits.valid, np.minimum(off / tolerance, 1e3) ** 2, np.inf)
    some = np.isfinite(node).any(1)
    index = np.flatnonzero(some)
    depths = np.full(len(rays), np.nan)
    if not len(index):
        return depths
    chain = _cheapest_chain(node[index], place[index], tolerance)
    chosen = hits.depths_mm[index, chain]
    depths[index] = np.where(off[index, chain] <= tolerance, chosen, np.nan)
    return depths


def _cheapest_chain(node: Array, place: Array, tolerance: float) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Viterbi over two roots a ray: least node cost plus squared steps backwards along the arc."""
    # A tie of two forward chains goes to the evener one: a step costs a millionth of its square beyond what order costs.
    even = 1e-6
    total = node[0].copy()
    back = np.zeros(node.shape, dtype=np.intp)
    for k in range(1, len(node)):
        step = (place[k][None, :] - place[k - 1][:, None]) / tolerance
        cost = total[:, None] + np.where(step < 0, step * step, even * step * step)
        cost = np.where(np.isfinite(cost), cost, np.inf)
        back[k] = cost.argmin(0)
        total = cost.min(0) + node[k]
    chain = np.zeros(len(node), dtype=np.intp)
    chain[-1] = int(total.argmin())
    for k in range(len(node) - 1, 0, -1):
        chain[k - 1] = back[k, chain[k]]
    return chain


def place_along(arc_xy: Array, xy: Array) -> tuple[Array, Array]:
    """Nearest place of points on a polyline.

    Parameters
    ----------
    arc_xy
        (M, 2) polyline.
    xy
        (N, 2) points; rows of NaN give NaN.

    Returns
    -------
    place, off
        (N,) arc length along the polyline, extended in a straight line past both ends, and (N,) distance from it, past
        the ends the distance to the end point.
    """
    start, step = arc_xy[:-1], np.diff(arc_xy, axis=0)
    length = np.linalg.norm(step, axis=1)
    unit = step / length[:, None]
    along = np.concatenate([[0.0], np.cumsum(length)])
    offset = xy[:, None, :] - start[None]
    t = np.einsum("nmk,mk->nm", offset, unit)
    inside = np.clip(t, 0.0, length)
    distance = np.linalg.norm(offset - inside[..., None] * unit, axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    best = distance.argmin(1)
    rows = np.arange(len(xy))
    before = (best == 0) & (t[rows, best] < 0)
    after = (best == len(step) - 1) & (t[rows, best] > length[best])
    place = along[best] + np.where(before | after, t[rows, best], inside[rows, best])
    off = distance[rows, best]
    missing = ~np.isfinite(off)
    return np.where(missing, np.nan, place), np.where(missing, np.nan, off)


def epipolar_crossing(arc_xy: Array, epipole: Array) -> float:
    """How squarely the epipolar lines cross a curve: 10th percentile of |sin| of the angle between line and tangent.

    The view with the larger value makes the cone: its curve is crossed least tangentially by the other view's rays.

    Parameters
    ----------
    arc_xy
        (M, 2) centreline on the ideal image plane.
    epipole
        (3,) homogeneous image of the other camera's centre.
    """
    tangent = np.gradient(arc_xy, axis=0)
    towards = epipole[:2] - epipole[2] * arc_xy
    cross = tangent[:, 0] * towards[:, 1] - tangent[:, 1] * towards[:, 0]
    size = np.linalg.norm(tangent, axis=1) * np.linalg.norm(towards, axis=1)
    return float(np.percentile(np.abs(np.divide(cross, size, out=np.zeros_like(cross), where=size > 0)), 10))
