"""Places in pictures on the command line: ``--base left:960,52 right:948,60``, and ``--tip`` alike."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperCommand

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
_OPTIONS = ("--base", "--tip")
_PLACE = re.compile(rf"(\w[\w .-]*):({_NUMBER}),({_NUMBER})")


class PlacesCommand(TyperCommand):
    """A command whose ``--base`` and ``--tip`` take as many ``camera:X,Y`` as follow them."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat the option before each place that follows one."""
        expanded: list[str] = []
        for arg in args:
            option = expanded[-2] if len(expanded) >= 2 else ""
            if option in _OPTIONS and _PLACE.fullmatch(arg):
                expanded.append(option)
            expanded.append(arg)
        return super().parse_args(ctx, expanded)


def places_of(texts: Sequence[str], option: str = "--base") -> dict[str, tuple[float, float]]:
    """Pixels by camera; wrong usage where one is no ``camera:X,Y``."""
    places: dict[str, tuple[float, float]] = {}
    for text in texts:
        for part in text.split():
            match = _PLACE.fullmatch(part)
            if match is None:
                raise typer.BadParameter(f"expected CAMERA:X,Y such as left:960,52, got {part!r}", param_hint=option)
            places[match[1]] = (float(match[2]), float(match[3]))
    return places
