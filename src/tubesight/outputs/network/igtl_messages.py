"""Results as OpenIGTLink messages, packed by `pyigtl`'s message classes.

Protocol: Tokuda et al. 2009, OpenIGTLink: an open network protocol for image-guided therapy environment,
International Journal of Medical Robotics 5, 423.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from pyigtl.messages import MessageBase, PointMessage, PolyDataMessage, StringMessage, TransformMessage

from tubesight.core import Array, Status
from tubesight.geometry.pose import turn_onto

# Names under which clients see the messages: a transform is named `<what>To<frame>`, as PLUS does.
TIP, POINTS, CURVE, ANGLES, STATE = "TipToBase", "TubePoints", "Tube", "TubeShape", "TubeStatus"
# Every so many-th point of the curve is sent as a named POINT.
_POINT_EVERY = 4
# Codes of STATUS messages: all right, and not found.
_OK, _NOT_FOUND = 1, 4
# Longest text of a STATUS message.
_TEXT_BYTES = 400


class StatusMessage(MessageBase):  # type: ignore[misc]
    """STATUS: code, subcode, name of the error in 20 bytes, text that ends with a zero byte."""

    def __init__(self, code: int, name: str, text: str, timestamp: float) -> None:
        super().__init__(timestamp=timestamp, device_name=STATE)
        self._message_type = "STATUS"
        self._content = struct.pack("> H q 20s", code, 0, name.encode("ascii", "replace")[:19])
        self._content += text.encode("ascii", "replace")[:_TEXT_BYTES] + b"\0"

    def _pack_content(self) -> bytes:
        return self._content


# Headers of version 2 carry metadata; libraries before OpenIGTLink 3 read version 1 alone.
PLAIN, WITH_METADATA = 1, 2


def pack_status(ok: bool, name: str, text: str, time_s: float) -> bytes:
    """Pack a STATUS message, with a plain header, which every client reads."""
    return bytes(StatusMessage(_OK if ok else _NOT_FOUND, "" if ok else name, text, time_s).pack())


def pack_result(message: dict[str, Any], time_s: float, version: int = PLAIN) -> bytes:
    """Pack a result (`result_message`) as messages in a row.

    TRANSFORM of the tip, POINT and POLYDATA of the curve and STRING of angles and length where the status is ``ok``;
    STATUS always. A transform of a result that is not ``ok`` is not sent: it would be an old one.

    Parameters
    ----------
    time_s
        Time stamp, seconds since 1970.
    version
        Of the headers: `PLAIN`, or `WITH_METADATA` as PLUS writes them.
    """
    ok = message["status"] == Status.OK
    state = pack_status(ok, message["status"], "; ".join(message["notes"]), time_s)
    if not ok:
        return state
    curve = np.array(message["curve_mm"])
    line = np.concatenate([[len(curve)], np.arange(len(curve))])
    points = curve[::_POINT_EVERY]
    angles = {k: message[k] for k in ("bending_deg", "orientation_deg", "length_mm", "curvature_per_mm", "sd")}
    parts = (
        TransformMessage(tip_pose(message), time_s, TIP),
        PointMessage(points, [f"{k * _POINT_EVERY}" for k in range(len(points))], timestamp=time_s, device_name=POINTS),
        PolyDataMessage(points=curve, lines=line, timestamp=time_s, device_name=CURVE),
        StringMessage(json.dumps(angles), time_s, ANGLES),
    )
    about = {"TransformValid": "True", "TransformStatus": "OK"}
    about |= {"FrameNumber": str(message["number"]), "Method": message["method"], "Model": str(message["model"])}
    for part in parts:
        part.header_version = version
        if version >= WITH_METADATA:
            part.message_id, part.metadata = message["number"] % 2**32, about
    return b"".join(part.pack() for part in parts) + state


def tip_pose(message: dict[str, Any]) -> Array:
    """``base_from_tip`` (4, 4): z is the tangent at the tip, x and y are turned with it from the base (`turn_onto`)."""
    pose = np.eye(4)
    pose[:3, :3] = turn_onto(np.array(message["tip_direction"]))
    pose[:3, 3] = message["tip_mm"]
    return pose
