"""``tubesight devices``."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer


def command(json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False) -> None:
    """List the cameras of this machine by name and serial number.

    tubesight devices
    """
    from tubesight.cli.console import stdout
    from tubesight.files.tables import to_json
    from tubesight.sources.devices import list_devices, supported

    devices = list_devices()
    if json:
        typer.echo(to_json({"devices": [asdict(device) for device in devices]}))
        return
    console = stdout()
    if not devices:
        where = "no camera found; plug one in" if supported() else "cameras can be listed on Linux only; use its number"
        console.print(
            f"{where}. Folders of pictures, videos and cameras in the network need none here.", soft_wrap=True
        )
    for device in devices:
        serial = f"serial {device.serial}" if device.serial else "no serial number"
        console.print(f"{device.node}  {device.name}, {serial}", soft_wrap=True)
        for link in filter(None, (device.by_id, device.by_path)):
            console.print(f"  {link}", soft_wrap=True)
        if not device.readable:
            console.print("  cannot be opened: sudo usermod -aG video $USER, then log in again", soft_wrap=True)
