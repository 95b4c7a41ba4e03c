"""The cone over a conic and the rays of another camera: every root, then the choice of one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Indices, Mask
from tubesight.geometry.conic import Conic
from tubesight.geometry.polyline import place_along
from tubesight.geometry.pose import Pose

# A discriminant this small against the sizes it is summed from is a tangent ray: exact double roots come out below
# 1e-15, rays undistorted to 1e-13 below 1e-12, so that no exact ray is lost. Such roots differ by a share of 1e-6.
_TANGENT = 1e-12
# What a change of step along the arc costs against the same step backwards: it has to break ties between chains that
# run forwards, and no more. Poses with a root chosen 2 mm off or more, 0.1 px of noise, random rigs, a fourth of the
# tubes at 90 degrees: 2.1 % at 1e-3, 3.9 % at 1e-6; from 1e-2 on exact data swap roots that nearly coincide.
_EVENNESS = 1e-3


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
        (equations 6 to 9 of Dalvand et al. 2016), in the conic's principal frame and by the form of the quadratic
        formula that does not cancel. A root at infinity (a ray parallel to a line of the cone) is NaN, the other one
        stays. A double line gives the meeting point with its plane, twice, and NaN for a ray in that plane or parallel
        to it.

        Near a tangent ray both roots lose digits: with coefficients known to a share e they are known to ``e / sin`` of
        the angle at which the ray's image crosses the conic, down to ``sqrt(e)`` for the tangent ray itself.

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
            depths, tangent = _roots(self.conic.normal, a, b)
        depths = np.where(np.isfinite(depths), depths, np.nan)
        other = rays[:, None, :] * depths[..., None] @ cone_from_ray.rotation.T + cone_from_ray.translation_mm
        return Hits(depths, np.asarray((depths > 0) & (other[..., 2] > 0)), tangent & np.isfinite(depths).any(1))


def _roots(conic: Array, a: Array, b: Array) -> tuple[Array, Mask]:
    """Both roots r (N, 2), ascending, of ``(a r + b)^T C (a r + b) = 0`` for a (N, 3) and b (3,), and which are double.

    The discriminant ``(a^T C b)^2 - (a^T C a)(b^T C b)`` is ``-l^T adj(C) l`` with the epipolar line ``l = a x b``: the
    conic of tangent lines, evaluated at the line. That form cancels only where the line really is a tangent.
    """
    tangents = np.cross(conic[[1, 2, 0]], conic[[2, 0, 1]])
    line = np.cross(a, b)
    discriminant = -np.einsum("ni,ij,nj->n", line, tangents, line)
    size = np.einsum("ni,ij,nj->n", np.abs(line), np.abs(tangents), np.abs(line))
    tangent = np.abs(discriminant) <= _TANGENT * size
    root = np.sqrt(np.where(discriminant > 0, discriminant, np.where(tangent, 0.0, np.nan)))
    half, constant = a @ conic @ b, b @ conic @ b
    q = -(half + np.where(half >= 0, root, -root))
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.stack([q / np.einsum("ni,ij,nj->n", a, conic, a), constant / q], -1)
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

    Each root is carried to the cone's image plane and there to its place along the observed arc. The chain of roots of
    least cost is found by dynamic programming; the cost is the distance off the arc, beyond its ends included, and any
    step backwards along it, both in units of `tolerance`. Of two chains that run forwards the evener one wins.

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
    chain = _cheapest_chain(node[index], place[index] / tolerance, np.diff(index))
    chosen = hits.depths_mm[index, chain]
    depths[index] = np.where(off[index, chain] <= tolerance, chosen, np.nan)
    return depths


def _cheapest_chain(node: Array, place: Array, rays_apart: Indices) -> Indices:
    """Viterbi over pairs of neighbouring roots: node costs, squared steps backwards, and squared changes of step.

    Steps over lost rays count by the ray.
    """
    if len(node) == 1:
        return np.array([int(node[0].argmin())])
    # step[k, i, j]: from root i of ray k to root j of ray k + 1; roots that are not valid have an infinite node cost.
    step = np.nan_to_num(place[1:, None, :] - place[:-1, :, None])
    arrival = np.minimum(step, 0.0) ** 2 + node[1:, None, :]
    step = step / rays_apart[:, None, None]
    # change[k, h, i, j]: along root h of ray k, root i of the next, root j of the one after that.
    change = _EVENNESS * (step[1:, None, :, :] - step[:-1, :, :, None]) ** 2
    total = node[0][:, None] + arrival[0]
    before = np.zeros((len(node), 2, 2), dtype=np.intp)
    for k in range(2, len(node)):
        cost = total[:, :, None] + change[k - 2]
        before[k] = cost.argmin(0)
        total = cost.min(0) + arrival[k - 1]
    chain = np.zeros(len(node), dtype=np.intp)
    chain[-2:] = np.unravel_index(int(total.argmin()), total.shape)
    for k in range(len(node) - 1, 1, -1):
        chain[k - 2] = before[k, chain[k - 1], chain[k]]
    return chain


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
