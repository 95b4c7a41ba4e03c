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
        "figure4": "what each stage of the image processing makes of a photograph",
        "experiment1": "five tubes at eight orientations (figures 5 to 7)",
    }
)


def study(name: str) -> Run:
    """Return ``run`` of the study's module, ``tubesight.apps.reproduce.NAME``."""
    run: Run = import_module(f"tubesight.apps.reproduce.{name}").run
    return run
