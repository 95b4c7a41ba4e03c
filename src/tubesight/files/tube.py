"""``tube.yaml``: what the user knows of the tube."""

from __future__ import annotations

import math
from pathlib import Path

from pydantic import PositiveFloat

from tubesight.core import InputError, Tip, TipShape, Tube
from tubesight.files.nested import dump_yaml, parse_yaml
from tubesight.files.safe import Strict, load_yaml, refuse, validate


class _TipFile(Strict):
    shape: TipShape
    diameter_mm: PositiveFloat | None = None


class _TubeFile(Strict):
    diameter_mm: PositiveFloat | None = None
    tip: _TipFile = _TipFile(shape="round")
    clamped: bool = False
    tapered: bool = False


def load_tube(path: Path) -> Tube:
    """Read ``tube.yaml``; raise `InputError` where it does not describe a tube.

    A round or flat end has the tube's own diameter: it may be repeated in the file, but not differ. An open end has
    none.
    """
    return _tube(load_yaml(path, _TubeFile), path)


def tube_from_text(text: str, path: Path) -> Tube:
    """Read the text of a ``tube.yaml`` that lies in another file."""
    return _tube(validate(parse_yaml(text, path), _TubeFile, path), path)


def tube_text(tube: Tube) -> str:
    """Write a tube as ``tube.yaml`` has it."""
    tip = {"shape": tube.tip.shape, **({"diameter_mm": tube.tip.diameter_mm} if tube.tip.diameter_mm else {})}
    known = {"diameter_mm": tube.diameter_mm} if tube.diameter_mm is not None else {}
    return dump_yaml({**known, "tip": tip, "clamped": tube.clamped})


def _tube(file: _TubeFile, path: Path) -> Tube:
    tip_mm = file.tip.diameter_mm
    if file.tip.shape == "open" and tip_mm is not None:
        raise InputError(f"{path}: tip.diameter_mm: an open end has no diameter; remove the key")
    if file.tip.shape != "ball" and tip_mm is not None:
        if file.diameter_mm is None or not math.isclose(tip_mm, file.diameter_mm, rel_tol=1e-3):
            raise InputError(
                f"{path}: tip.diameter_mm: a {file.tip.shape} end has the tube's own diameter; remove the key, "
                "or write 'shape: ball'"
            )
        tip_mm = None
    try:
        return Tube(file.diameter_mm, Tip(file.tip.shape, tip_mm), file.clamped, file.tapered)
    except ValueError as error:
        refuse(path, error)
