"""``tubesight devices``: the cameras of this machine, by name and serial number."""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Device:
    """A camera as Video4Linux knows it.

    Attributes
    ----------
    node
        ``/dev/videoN``; N changes with the order of plugging in.
    name
        What the driver calls it.
    serial
        Serial number of the USB device; None where it has none.
    by_id, by_path
        Links that stay: by maker, model and serial number, and by the socket it is plugged into; None where the system
        makes none. Two cameras of one model without serial numbers differ by socket alone.
    readable
        Whether this user may open it.
    """

    node: str
    name: str
    serial: str | None
    by_id: str | None
    by_path: str | None
    readable: bool


def supported() -> bool:
    """Whether this system lists its cameras in a way known here."""
    return sys.platform.startswith("linux")


def list_devices(root: Path = Path("/")) -> tuple[Device, ...]:
    """Cameras in the order of their nodes; empty where there are none.

    A camera may have several nodes; all but its first one (``index`` 0) hold metadata or other formats and are left
    out.

    Parameters
    ----------
    root
        Where ``sys`` and ``dev`` are.
    """
    entries = (root / "sys/class/video4linux").glob("video*")
    numbered = sorted((int(m[1]), path) for path in entries if (m := re.fullmatch(r"video(\d+)", path.name)))
    by_id, by_path = (_links(root / "dev/v4l" / kind) for kind in ("by-id", "by-path"))
    found = []
    for _, entry in numbered:
        if (_read(entry / "index") or "0") != "0":
            continue
        node = root / "dev" / entry.name
        found.append(
            Device(
                node=str(node),
                name=_read(entry / "name") or entry.name,
                serial=_serial(entry),
                by_id=by_id.get(entry.name),
                by_path=by_path.get(entry.name),
                readable=os.access(node, os.R_OK | os.W_OK),
            )
        )
    return tuple(found)


def _links(folder: Path) -> dict[str, str]:
    """Links in a folder by the name of what they lead to."""
    if not folder.is_dir():
        return {}
    return {path.resolve().name: str(path) for path in sorted(folder.iterdir(), reverse=True)}


def _serial(entry: Path) -> str | None:
    """Read the serial number of the USB device: the camera hangs on an interface below it."""
    device = (entry / "device").resolve()
    for folder in (device, device.parent):
        # A host controller has a file `serial` too: only what has a product number is a device.
        if (folder / "idProduct").is_file():
            return _read(folder / "serial")
    return None


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip() or None
    except OSError:
        return None
