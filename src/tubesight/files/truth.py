"""``truth.json``: exact shapes to judge results by."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat

from tubesight.core import Array, InputError, readonly
from tubesight.files.safe import Strict, load_json

# 10000 frames with a centreline of 100 points take about 40 MiB.
_TRUTH_BYTES = 64 << 20

_Row = tuple[float, float, float]


class _FrameFile(Strict):
    frame: str
    shape: dict[str, Any] = Field(default_factory=dict)
    kind: str = ""
    tip: _Row
    length: PositiveFloat
    theta: NonNegativeFloat
    phi: float | None = None
    centreline: list[_Row] = Field(min_length=2)


class _TruthFile(Strict):
    units: Literal["mm, deg"]
    frames: list[_FrameFile] = Field(min_length=1)


@dataclass(frozen=True, slots=True, eq=False)
class TrueShape:
    """The truth of one frame, in the base frame.

    Attributes
    ----------
    kind
        What was photographed: ``circle``, ``ellipse``, ``straight`` ...
    tip_mm
        (3,)
    bending_deg, orientation_deg
        theta and phi; phi is NaN for a straight tube, which has none.
    centreline_mm
        (N, 3) from base to tip.
    """

    kind: str
    tip_mm: Array
    length_mm: float
    bending_deg: float
    orientation_deg: float
    centreline_mm: Array


def load_truth(path: Path) -> dict[str, TrueShape]:
    """Read ``truth.json``: the true shape by frame."""
    truth: dict[str, TrueShape] = {}
    for frame in load_json(path, _TruthFile, _TRUTH_BYTES).frames:
        if frame.frame in truth:
            raise InputError(f"{path}: frame {frame.frame!r} is there twice; remove one")
        straight = frame.kind == "straight" or frame.phi is None
        truth[frame.frame] = TrueShape(
            frame.kind,
            readonly(frame.tip, (3,), "tip"),
            frame.length,
            frame.theta,
            float("nan") if straight or frame.phi is None else frame.phi,
            readonly(frame.centreline, (None, 3), "centreline"),
        )
    return truth
