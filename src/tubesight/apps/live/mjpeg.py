"""Simulated cameras on the network: motion JPEG over HTTP, as web cameras send it; pictures carry their instant."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2

from tubesight.core import Image
from tubesight.geometry.rig import Rig
from tubesight.outputs.network.access import LOOPBACK
from tubesight.sources.reader import Wanted
from tubesight.sources.simulated import SIM_TUBE, sim_picture, sim_rig

# One swing to and fro of the simulated tube.
SWING = 30
# The number of a picture within its swing is written into its lower left corner: one square a bit, black or white,
# large enough to survive JPEG, whose blocks are of 8 pixels.
_BITS, _SQUARE_PX = 5, 16


def write_number(image: Image, number: int) -> Image:
    """Return a picture with its number (0 to 31) in its corner."""
    marked = image.copy()
    for bit in range(_BITS):
        marked[-_SQUARE_PX:, bit * _SQUARE_PX : (bit + 1) * _SQUARE_PX] = 255 * (number >> bit & 1)
    return marked


def read_number(image: Image) -> int:
    """Read what `write_number` wrote."""
    squares = (image[-_SQUARE_PX:, bit * _SQUARE_PX : (bit + 1) * _SQUARE_PX] for bit in range(_BITS))
    return sum((float(square.mean()) > 127.5) << bit for bit, square in enumerate(squares))


def coded_swing(size_px: tuple[int, int], quality: int = 90) -> tuple[dict[str, list[bytes]], Rig]:
    """Photograph one swing with two cameras: JPEGs by camera, and the rig."""
    rig = sim_rig(size_px, ("left", "right"))
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]

    def coded(name: str, number: int) -> bytes:
        image = write_number(sim_picture(Wanted(name, rig=rig, tube=SIM_TUBE), number), number)
        return cv2.imencode(".jpg", image, options)[1].tobytes()

    return {name: [coded(name, number) for number in range(SWING)] for name in rig.names}, rig


@contextmanager
def serve(swing: Mapping[str, Sequence[bytes]], hz: float, port: int = 0) -> Iterator[str]:
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
                    data = pictures[number % len(pictures)]
                    head = (
                        f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n"
                        f"X-Timestamp: {number / hz:.6f}\r\n\r\n"
                    )
                    self.wfile.write(head.encode() + data + b"\r\n")

        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer((LOOPBACK, port), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield f"http://{LOOPBACK}:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
