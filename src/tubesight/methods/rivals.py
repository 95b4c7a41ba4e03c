"""The systems of table 2 of Dalvand et al. 2016, as methods: each reconstructed from what its authors published."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from tubesight.methods import markers
from tubesight.methods.method import Method
from tubesight.vision.bands import Bands

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
    }
)
