"""The studies by name, in the order of the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tubesight.apps.reproduce.study import Context, StudyResult

# What each study shows. The study NAME is the module tubesight.apps.reproduce.NAME, imported when it runs.
STUDIES: Mapping[str, str] = MappingProxyType(
    {
        "figure2": "the geometry, theta and phi",
        "figure3": "the set-up and what its cameras see",
        "figure4": "what each stage of the image processing makes of a photograph",
        "experiment1": "five tubes at eight orientations (figures 5 to 7)",
        "experiment2": "eight tubes turned once round (figures 8 to 11)",
        "sensitivity": "what each thing that can be wrong costs",
        "timing": "what a pair of pictures costs (section 4)",
        "table1": "noise of millimetres on the centreline points (table 1)",
        "viewing_angle": "the angle between the cameras and the direction of the tube",
        "uncertainty": "errors of the fit against what the edges allow and what it states",
    }
)


def study(name: str) -> Callable[[Context], StudyResult]:
    """Return ``run`` of the study's module."""
    run: Callable[[Context], StudyResult] = import_module(f"tubesight.apps.reproduce.{name}").run
    return run
