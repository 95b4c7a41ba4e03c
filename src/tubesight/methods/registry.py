"""Methods by name: each is a way to see the tube in a picture and a way to turn the views into a curve."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from tubesight.methods import cone_ray, dalvand, epipolar_dp, silhouette, spline_fit, triangulate
from tubesight.methods.method import Method
from tubesight.methods.plugins import Registry
from tubesight.methods.rivals import RIVALS
from tubesight.vision.reference import Reference

_PAPER = (
    "Dalvand, Nahavandi, Howe 2016, Fast vision-based catheter 3D reconstruction, "
    "Physics in Medicine and Biology 61, 5128"
)
# Row "proposed" of table 2 of the paper, with what each row says in words.
_PAPER_TRAITS: Mapping[str, str] = MappingProxyType(
    {
        "cameras": "2",
        "markers": "none",
        "physical grid": "none",
        "initial guess": "none",
        "circular arcs": "not needed: any quadratic curve",
        "tip": "yes",
        "3-D": "yes",
    }
)
# What two matched centrelines give, whatever the shape.
_MATCHING_TRAITS: Mapping[str, str] = MappingProxyType(
    {
        "cameras": "2",
        "markers": "none",
        "physical grid": "none",
        "initial guess": "none",
        "circular arcs": "not needed: any smooth curve",
        "tip": "yes",
        "3-D": "yes",
    }
)

_SILHOUETTE = silhouette.Silhouette(starter=cone_ray.solve, general=epipolar_dp.start)

METHODS: Mapping[str, Method] = Registry(
    {
        "cone_ray": Method(
            name="cone_ray",
            summary="closed form: the rays of one camera meet the cone over the conic of the other",
            citation=_PAPER,
            traits=_PAPER_TRAITS,
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
                    "circular arcs": "not needed: arcs, ellipses, several segments, splines of curvature",
                    "tip": "yes",
                    "3-D": "yes",
                }
            ),
            solve=_SILHOUETTE,
            whole=True,
            solve_again=_SILHOUETTE,
        ),
        "reference": Method(
            name="reference",
            summary="the paper's image processing and solve literally, to compare with: a white tube with a ball that "
            "hangs before coloured cloth",
            citation=_PAPER,
            traits=_PAPER_TRAITS,
            solve=dalvand.solve,
            see=Reference(whole=True),
        ),
        "reference_crop": Method(
            name="reference_crop",
            summary="`reference`, with only the crop undistorted",
            citation=_PAPER,
            traits=_PAPER_TRAITS,
            solve=dalvand.solve,
            see=Reference(whole=False),
        ),
        "triangulate": Method(
            name="triangulate",
            summary="the naive baseline: both centrelines cut into equal shares of their length, paired, triangulated",
            citation="common practice; Hartley, Zisserman 2004, Multiple View Geometry, section 12.2 (linear method)",
            traits=_MATCHING_TRAITS,
            solve=triangulate.solve,
        ),
        "epipolar_dp": Method(
            name="epipolar_dp",
            summary="both centrelines matched along epipolar lines by dynamic programming, smoothing spline",
            citation="after Hoffmann, Brost, Schaefer, Koch, Bourier, Strobel 2012, Semi-automatic catheter "
            "reconstruction from two views, MICCAI, LNCS 7511, 584",
            traits=_MATCHING_TRAITS,
            solve=epipolar_dp.solve,
        ),
        "spline_fit": Method(
            name="spline_fit",
            summary="one B-spline in space fitted to the centrelines of all views, from `epipolar_dp`",
            citation="tubesight; P-splines: Eilers, Marx 1996, Statistical Science 11, 89",
            traits=MappingProxyType({**_MATCHING_TRAITS, "cameras": "2 or more"}),
            solve=spline_fit.SplineFit(starter=epipolar_dp.solve),
        ),
        **RIVALS,
    }
)
