"""The nouns everything shares; no logic."""

from tubesight.core.arrays import Array, Image, Indices, Mask, readonly, sealed
from tubesight.core.board import Board
from tubesight.core.errors import InputError
from tubesight.core.frames import Frame, FramePair
from tubesight.core.status import Status, Unmeasurable
from tubesight.core.tube import Tip, TipShape, Tube

__all__ = [
    "Array",
    "Board",
    "Frame",
    "FramePair",
    "Image",
    "Indices",
    "InputError",
    "Mask",
    "Status",
    "Tip",
    "TipShape",
    "Tube",
    "Unmeasurable",
    "readonly",
    "sealed",
]
