"""How far a fitted curve may be off, as a covariance of its parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import overload

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import COMPILED
from tubesight.geometry import shape_kernels
from tubesight.geometry.curve import NodeCurve
from tubesight.geometry.families import Nodes

# Principal deviations smaller than this share of the largest displace a curve by nothing that counts.
_NEGLIGIBLE = 1e-9


class Deviations(Sequence[NodeCurve]):
    """A curve displaced by one standard deviation along each principal direction of a covariance, linearised.

    The covariance and the displaced curves are made when they are first asked for.

    Parameters
    ----------
    model
        Name of the family.
    nodes
        The curve with its derivatives by P parameters.
    covariance
        Returns their covariance (P, P).
    """

    def __init__(self, model: str, nodes: Nodes, covariance: Callable[[], Array]) -> None:
        self.model = model
        self.nodes = nodes
        self._make = covariance

    @cached_property
    def covariance(self) -> Array:
        """Covariance (P, P) of the parameters."""
        return self._make()

    @cached_property
    def curves(self) -> tuple[NodeCurve, ...]:
        """The displaced curves."""
        values, vectors = np.linalg.eigh(self.covariance)
        factor = vectors * np.sqrt(np.clip(values, 0.0, None))
        nodes = self.nodes
        s = nodes.s_mm[:, None] + nodes.d_s @ factor
        points = nodes.points[..., None] + nodes.d_points @ factor
        tangents = nodes.tangents[..., None] + np.cross(nodes.d_turn @ factor, nodes.tangents[..., None], axis=1)
        return tuple(
            NodeCurve(self.model, s[:, k], points[..., k], tangents[..., k])
            for k in range(len(values))
            if values[k] > _NEGLIGIBLE**2 * values[-1]
        )

    def bounded(self) -> bool:
        """Whether every arc of the curve is longer than its deviation, so that displaced curves have an order."""
        check = shape_kernels.bounded if COMPILED else bounded
        return bool(check(self.nodes.s_mm, self.nodes.d_s, self.covariance))

    def across_mm(self) -> Array:
        """Return the largest standard deviation (M,) of each node's place across the curve."""
        points, along = self.nodes.d_points, self.nodes.tangents
        points = points - along[:, :, None] * np.einsum("mi,mip->mp", along, points)[:, None]
        squares = np.linalg.eigvalsh(np.einsum("mip,pq,mjq->mij", points, self.covariance, points))
        return np.asarray(np.sqrt(np.maximum(squares[:, -1], 0.0)))

    def __len__(self) -> int:
        return len(self.curves)

    def __bool__(self) -> bool:
        return True

    @overload
    def __getitem__(self, index: int) -> NodeCurve: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[NodeCurve]: ...
    def __getitem__(self, index: int | slice) -> NodeCurve | Sequence[NodeCurve]:
        """Return displaced curves by place."""
        return self.curves[index]


def bounded(s: Array, d_s: Array, covariance: Array) -> bool:
    """Whether all lengths between nodes at s (M,) are larger than their deviation; d_s (M, P) by the parameters."""
    lengths, d = s[1:] - s[:-1], d_s[1:] - d_s[:-1]
    return bool((((d @ covariance) * d).sum(1) < lengths**2).all())
