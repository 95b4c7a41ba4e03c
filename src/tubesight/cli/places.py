"""Places in pictures on the command line: ``--base left:960,52 right:948,60``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperCommand

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
_BASE = re.compile(rf"(\w[\w .-]*):({_NUMBER}),({_NUMBER})")


class BaseCommand(TyperCommand):
    """A command whose ``--base`` takes as many ``camera:X,Y`` as follow it."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat ``--base`` before each place that follows one."""
        expanded: list[str] = []
        for arg in args:
            follows = len(expanded) >= 2 and expanded[-2] == "--base"
            if follows and _BASE.fullmatch(arg):
                expanded.append("--base")
            expanded.append(arg)
        return super().parse_args(ctx, expanded)


def places_of(base: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Pixels by camera; wrong usage where one is no ``camera:X,Y``."""
    places: dict[str, tuple[float, float]] = {}
    for text in base:
        for part in text.split():
            match = _BASE.fullmatch(part)
            if match is None:
                raise typer.BadParameter(f"expected CAMERA:X,Y such as left:960,52, got {part!r}", param_hint="--base")
            places[match[1]] = (float(match[2]), float(match[3]))
    return places
