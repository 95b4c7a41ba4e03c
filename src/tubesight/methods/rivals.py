"""The systems of table 2 of Dalvand et al. 2016, as methods: each reconstructed from what its authors published."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from tubesight.methods import affine_shape, arcs_planar, carving, epipolar, markers, markers_arcs, nurbs, som, symmetric
from tubesight.methods.method import Method
from tubesight.vision.bands import Bands
from tubesight.vision.region import see_region

RIVALS: Mapping[str, Method] = MappingProxyType(
    {
        "markers": Method(
            name="markers",
            summary="bands all along the tube, triangulated one by one and joined by a natural spline",
            citation="after Rucker, Webster 2011, Statics and dynamics of continuum robots with general tendon routing "
            "and external loading, IEEE Transactions on Robotics 27, 1033",
            traits=MappingProxyType(
                {
                    "cameras": "2",
                    "markers": "bands all along the tube",
                    "physical grid": "none",
                    "initial guess": "none",
                    "circular arcs": "not needed: spline through the bands",
                    "tip": "yes: the last band",
                    "3-D": "yes",
                }
            ),
            solve=markers.solve,
            see=Bands(),
            given=("markers",),
            scene="bands",
        ),
        "epipolar": Method(
            name="epipolar",
            summary="two views side by side, matched point by point where epipolar lines cross the other centreline",
            citation="after Lee, Poston 1997, Epipolar reconstruction of blood vessels from near views",
            traits=MappingProxyType(
                {
                    "cameras": "2, two degrees apart",
                    "markers": "none",
                    "physical grid": "none",
                    "initial guess": "none",
                    "circular arcs": "not needed: smoothing spline",
                    "tip": "yes",
                    "3-D": "yes",
                }
            ),
            solve=epipolar.solve,
            scene="near pair",
        ),
        "arcs_planar": Method(
            name="arcs_planar",
            summary="marked section ends in one picture, one arc a section, in the plane of bending",
            citation="after Hannan, Walker 2005, Real-time shape estimation for continuum robots using vision, "
            "Robotica 23, 645",
            traits=MappingProxyType(
                {
                    "cameras": "1, and the plane of bending",
                    "markers": "at the ends of sections",
                    "physical grid": "none",
                    "initial guess": "none",
                    "circular arcs": "one a section",
                    "tip": "yes: the last band",
                    "3-D": "no: planar",
                }
            ),
            solve=arcs_planar.solve,
            see=Bands(),
            given=("markers", "plane of bending"),
            scene="sections",
        ),
        "markers_arcs": Method(
            name="markers_arcs",
            summary="bands on each section, triangulated; one arc a section, each continuing the one before",
            citation="after Webster, Romano, Cowan 2009, Mechanics of precurved-tube continuum robots, IEEE "
            "Transactions on Robotics 25, 67",
            traits=MappingProxyType(
                {
                    "cameras": "2",
                    "markers": "on each section",
                    "physical grid": "for the original's calibration",
                    "initial guess": "none",
                    "circular arcs": "one a section",
                    "tip": "yes: the last band",
                    "3-D": "yes",
                }
            ),
            solve=markers_arcs.MarkersArcs(),
            see=Bands(),
            given=("markers", "bands a section"),
            scene="grid",
        ),
        "nurbs": Method(
            name="nurbs",
            summary="a spline in space pulled onto the edges of all pictures, with as many knots as they are worth",
            citation="after Martinsson, Gaspard, Bartoli, Lavest 2007, Energy-based reconstruction of 3D curves for "
            "quality control, EMMCVPR, LNCS 4679, 414",
            traits=MappingProxyType(
                {
                    "cameras": "2 or more, here 4",
                    "markers": "none",
                    "physical grid": "none",
                    "initial guess": "a coarse polygon, here triangulated",
                    "circular arcs": "not needed: spline",
                    "tip": "no: ends stay where the polygon has them",
                    "3-D": "yes",
                }
            ),
            solve=nurbs.solve,
            see=see_region,
            given=("4 views",),
            scene="four cameras",
        ),
        "carving": Method(
            name="carving",
            summary="space carved by the silhouettes of many cameras, thinned to a centreline",
            citation="after Camarillo, Loewke, Carlson, Salisbury 2008, Vision based 3-D shape sensing of flexible "
            "manipulators, ICRA, 2940",
            traits=MappingProxyType(
                {
                    "cameras": "3 or more, here 8",
                    "markers": "none",
                    "physical grid": "none",
                    "initial guess": "none",
                    "circular arcs": "not needed: smoothing spline",
                    "tip": "yes",
                    "3-D": "yes",
                }
            ),
            solve=carving.solve,
            see=see_region,
            given=("8 views",),
            scene="eight cameras",
        ),
        "som": Method(
            name="som",
            summary="a chain of neurons drawn onto the silhouettes by a self-organising map",
            citation="after Croom, Rucker, Romano, Webster 2010, Visual sensing of continuum robot shape using "
            "self-organizing maps, ICRA, 4591",
            traits=MappingProxyType(
                {
                    "cameras": "2 or more",
                    "markers": "none",
                    "physical grid": "none",
                    "initial guess": "a chain, here a straight one",
                    "circular arcs": "not needed: chain",
                    "tip": "no: its ends shrink",
                    "3-D": "yes",
                }
            ),
            solve=som.solve,
            see=see_region,
            given=("initial guess",),
        ),
        "affine_shape": Method(
            name="affine_shape",
            summary="corresponding places of uncalibrated pictures of one curve by factorisation, then triangulated",
            citation="after Berthilsson, Astrom 1997, Reconstruction of 3D curves from 2D images using affine shape "
            "methods for curves, CVPR, 476",
            traits=MappingProxyType(
                {
                    "cameras": "3 or more, here 4, calibrated for the scale alone",
                    "markers": "none",
                    "physical grid": "none",
                    "initial guess": "none",
                    "circular arcs": "not needed: smoothing spline",
                    "tip": "yes",
                    "3-D": "yes",
                }
            ),
            solve=affine_shape.solve,
            given=("4 views",),
            scene="four cameras",
        ),
        "symmetric": Method(
            name="symmetric",
            summary="a mirror-symmetric curve and its reflection as a stereo pair, for the plane that suits two views",
            citation="after Hong, Ma, Yu 2004, Reconstruction of 3-D symmetric curves from perspective images without "
            "discrete features, ECCV, LNCS 3023, 533",
            traits=MappingProxyType(
                {
                    "cameras": "2, off the mirror plane",
                    "markers": "none",
                    "physical grid": "none",
                    "initial guess": "none",
                    "circular arcs": "needed, or another mirror-symmetric curve",
                    "tip": "yes: the mirror image of the base",
                    "3-D": "yes",
                }
            ),
            solve=symmetric.solve,
            given=("mirror symmetry",),
            scene="low pair",
        ),
    }
)
