"""A result as JSON: what the network outputs send, one object a line or WebSocket message, and its published schema."""

from __future__ import annotations

import json
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tubesight.core import InputError

# Longest message that a reader takes: 33 points and their notes make 3 kB.
MESSAGE_BYTES = 1 << 20

Point = tuple[float, float, float]


class Deviations(BaseModel):
    """Standard deviations, in the units of the values; null where not known."""

    model_config = ConfigDict(extra="forbid")

    tip_mm: tuple[float | None, float | None, float | None]
    bending_deg: float | None
    orientation_deg: float | None
    length_mm: float | None
    curvature_per_mm: float | None


class ResultMessage(BaseModel):
    """Result of one pair of pictures, in the base frame."""

    model_config = ConfigDict(extra="forbid", title="tubesight result")

    format: Literal["tubesight-result/1"] = "tubesight-result/1"
    number: int = Field(ge=0, description="counts the results of this sender from 0")
    frame: str = Field(description="name of the pair of pictures")
    time_s: float | None = Field(description="time of the pictures, seconds since 1970 where the source knows it")
    status: str = Field(description="ok, or a short code; without ok there are no numbers")
    notes: list[str] = Field(description="cautions, or what failed and what to do")
    method: str
    model: str | None = Field(description="family of the curve")
    tip_mm: Point | None
    tip_direction: Point | None = Field(description="unit tangent at the tip, away from the base")
    bending_deg: float | None
    orientation_deg: float | None = Field(description="null where the tip lies on the base axis")
    length_mm: float | None
    curvature_per_mm: float | None
    sd: Deviations | None
    curve_mm: list[Point] | None = Field(description="centreline from base to tip at equal arc lengths")
    curve_sd_mm: list[float | None] | None = Field(description="standard deviation of each of its points")
    fit_rms_px: float | None
    total_ms: float


def parse_message(text: str | bytes) -> ResultMessage:
    """Read one message; raise `InputError` where it is none.

    Lengths are capped before anything is parsed.
    """
    if len(text) > MESSAGE_BYTES:
        raise InputError(f"message: {len(text)} bytes, at most {MESSAGE_BYTES} are read; is this a tubesight sender?")
    try:
        return ResultMessage.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"])[:60]
        raise InputError(f"message: {place}: {first['msg']}; is this a tubesight sender?") from error


def message_schema() -> dict[str, Any]:
    """JSON Schema of `ResultMessage`."""
    return ResultMessage.model_json_schema()


def dump_message(message: dict[str, Any]) -> str:
    """Write a message on one line; numbers that are not finite are refused (they are null in a message)."""
    return json.dumps(message, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
