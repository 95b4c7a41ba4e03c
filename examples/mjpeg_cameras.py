"""Simulated cameras on the network: motion JPEG over HTTP, as web cameras send it.

    python examples/mjpeg_cameras.py --size 1920x1080 --hz 30 --port 8080

then, in another terminal, with the rig that it writes:

    tubesight live --source left=http://127.0.0.1:8080/left --source right=http://127.0.0.1:8080/right --rig rig.yaml
"""

from __future__ import annotations

import argparse
import time
from contextlib import suppress
from pathlib import Path

from tubesight.apps.live.mjpeg import coded_swing, serve
from tubesight.files.rig import save_rig
from tubesight.files.safe import write_atomic
from tubesight.files.tube import tube_text
from tubesight.sources.simulated import SIM_TUBE


def main() -> None:
    """Serve until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--hz", type=float, default=30.0)
    parser.add_argument("--port", type=int, default=8080)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("-o", "--out", type=Path, default=Path())
    given = parser.parse_args()
    width, height = (int(n) for n in given.size.split("x"))
    swing, rig = coded_swing((width, height))
    save_rig(given.out / "rig.yaml", rig)
    write_atomic(given.out / "tube.yaml", tube_text(SIM_TUBE))
    with serve(swing, given.hz, given.port) as address, suppress(KeyboardInterrupt):
        print(f"{address}/left and {address}/right; rig.yaml and tube.yaml are in {given.out.resolve()}", flush=True)
        end = time.monotonic() + given.seconds
        while time.monotonic() < end:
            time.sleep(0.1)


if __name__ == "__main__":
    main()
