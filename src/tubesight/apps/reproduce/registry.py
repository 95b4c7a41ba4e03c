"""The studies by name, in the order of the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import MappingProxyType

from tubesight.apps.reproduce.study import Context, StudyResult

Run = Callable[[Context], StudyResult]

# Module of each study, and what it shows in a few words for --help. Modules are imported when their study runs.
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


def study(name: str) -> Run:
    """Return ``run`` of the study's module, ``tubesight.apps.reproduce.NAME``."""
    run: Run = import_module(f"tubesight.apps.reproduce.{name}").run
    return run
