"""Simulated cameras on the network: motion JPEG over HTTP, as web cameras send it.

    python examples/mjpeg_cameras.py --size 1920x1080 --hz 30 --port 8080

then, in another terminal, with the rig that it writes:

    tubesight live --source left=http://127.0.0.1:8080/left --source right=http://127.0.0.1:8080/right --rig rig.yaml
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2

from tubesight.files.rig import save_rig
from tubesight.files.safe import write_atomic
from tubesight.files.tube import tube_text
from tubesight.sources.reader import Wanted
from tubesight.sources.simulated import SIM_TUBE, sim_picture, sim_rig

# One swing to and fro of the simulated tube.
SWING = 30


def coded_swing(size_px: tuple[int, int], quality: int = 90) -> tuple[dict[str, list[bytes]], object]:
    """Photograph one swing with both cameras: JPEGs by camera, and the rig."""
    rig = sim_rig(size_px, ("left", "right"))
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    swing = {
        name: [
            cv2.imencode(".jpg", sim_picture(Wanted(name, rig=rig, tube=SIM_TUBE), number), options)[1].tobytes()
            for number in range(SWING)
        ]
        for name in rig.names
    }
    return swing, rig


@contextmanager
def serve(swing: dict[str, list[bytes]], hz: float, port: int = 0) -> Iterator[str]:
    """Address under which the cameras answer, each at ``/NAME``; pictures carry the time they stand for."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            pictures = swing.get(self.path.strip("/"))
            if pictures is None:
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
            self.end_headers()
            number = int(time.monotonic() * hz)
            with suppress(OSError):
                while True:
                    number = max(number + 1, int(time.monotonic() * hz))
                    time.sleep(max(number / hz - time.monotonic(), 0.0))
                    data = pictures[number % SWING]
                    head = (
                        f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n"
                        f"X-Timestamp: {number / hz:.6f}\r\n\r\n"
                    )
                    self.wfile.write(head.encode() + data + b"\r\n")

        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


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
