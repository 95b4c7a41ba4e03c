"""Cameras on the loopback network: motion JPEG as web cameras send it, and servers that misbehave."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np

Respond = Callable[[BaseHTTPRequestHandler], None]


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


@contextmanager
def serve(respond: Respond) -> Iterator[str]:
    """Address of a server that answers every request with `respond`."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            with suppress(OSError):
                respond(self)

        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def stream(picture: Callable[[], bytes | None], hz: float, with_length: bool = True) -> Respond:
    """Motion JPEG of the picture of the moment, until there is none."""

    def respond(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        handler.end_headers()
        while (data := picture()) is not None:
            length = f"Content-Length: {len(data)}\r\n" if with_length else ""
            head = f"--frame\r\nContent-Type: image/jpeg\r\n{length}\r\n"
            handler.wfile.write(head.encode() + data + b"\r\n")
            time.sleep(1 / hz)
        if not with_length:
            handler.wfile.write(b"--frame--\r\n")

    return respond
