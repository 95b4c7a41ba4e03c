"""Methods by name: each turns views into a curve."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from tubesight.core import Tube
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.methods import cone_ray, silhouette
from tubesight.vision.view import View


@dataclass(frozen=True, slots=True)
class Method:
    """A registered method.

    Attributes
    ----------
    name, summary, citation
        Name on the command line, one sentence, and where it is from.
    traits
        A row of table 2 of Dalvand et al. 2016: what it needs and what it gives.
    solve
        ``(views, rig, tube) -> Curve3D``; raises `Unmeasurable` where the views do not give a curve.
    """

    name: str
    summary: str
    citation: str
    traits: Mapping[str, str]
    solve: Callable[[Mapping[str, View], Rig, Tube], Curve3D]


METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "cone_ray": Method(
            name="cone_ray",
            summary="closed form: the rays of one camera meet the cone over the conic of the other",
            citation="Dalvand, Nahavandi, Howe 2016, Fast vision-based catheter 3D reconstruction, "
            "Physics in Medicine and Biology 61, 5128",
            traits=MappingProxyType(
                {
                    "cameras": "2",
                    "markers": "none",
                    "physical grid": "none",
                    "initial guess": "none",
                    "circular arcs": "not needed: any quadratic curve",
                    "tip": "yes",
                    "3-D": "yes",
                }
            ),
            solve=cone_ray.solve,
        ),
        "silhouette": Method(
            name="silhouette",
            summary="least squares on the sub-pixel edges of all views, exact contour model, family by evidence",
            citation="tubesight",
            traits=MappingProxyType(
                {
                    "cameras": "2 or more",
                    "markers": "none",
                    "physical grid": "none",
                    "initial guess": "none",
                    "circular arcs": "not needed: arcs, ellipses, polynomials of curvature, several segments",
                    "tip": "yes",
                    "3-D": "yes",
                }
            ),
            solve=silhouette.Silhouette(starter=cone_ray.solve),
        ),
    }
)
