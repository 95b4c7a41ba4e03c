"""What a session talks to in a soak, in other processes: cameras on the network, clients of its outputs, a browser."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tubesight.apps.live.mjpeg import coded_swing, serve
from tubesight.core import InputError
from tubesight.outputs.network.access import LOOPBACK
from tubesight.outputs.network.igtl_server import HEADER

# Rendering a swing of pictures and importing everything takes up to 20 s on a busy machine.
_START_S = 120.0
_STOP_S = 5.0
_DATAGRAM_BYTES = 1 << 16
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_BROWSER_FLAGS = (
    "--headless",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--disable-background-networking",
    "--window-size=1280,800",
)


@contextmanager
def _process(run: Callable[..., None], *given: object) -> Iterator[Connection]:
    """Run a function in a process of its own, with a connection to it, until that is closed."""
    context = get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=run, args=(there, *given), daemon=True)
    process.start()
    there.close()
    try:
        yield here
    finally:
        here.close()
        process.join(_STOP_S)
        process.kill()
        process.join()


def _first(connection: Connection, what: str) -> Any:
    try:
        if connection.poll(_START_S):
            return connection.recv()
    except EOFError:
        pass
    raise InputError(f"{what}: did not start; look for its error above")


@contextmanager
def network_cameras(size_px: tuple[int, int], hz: float) -> Iterator[str]:
    """Start two simulated cameras that send motion JPEG; gives their address, to which ``/left`` and ``/right`` add."""
    with _process(_serve_cameras, size_px, hz) as connection:
        yield str(_first(connection, "simulated cameras"))


def _serve_cameras(connection: Connection, size_px: tuple[int, int], hz: float) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    swing, _ = coded_swing(size_px)
    with suppress(EOFError, OSError), serve(swing, hz) as address:
        connection.send(address)
        connection.recv()


class Clients:
    """Clients of every output, which count what they receive. Use `network_clients`.

    Attributes
    ----------
    udp_port
        Where datagrams are to be sent.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self.udp_port = int(_first(connection, "clients"))

    def connect(self, igtl_port: int, websocket_port: int) -> None:
        """Connect to the servers of a session."""
        self._connection.send((igtl_port, websocket_port))

    def received(self) -> dict[str, dict[str, int]]:
        """Messages by client and kind so far."""
        self._connection.send(None)
        return dict(self._connection.recv())


@contextmanager
def network_clients() -> Iterator[Clients]:
    """Start a client of each output, in a process of their own."""
    with _process(_receive) as connection:
        yield Clients(connection)


def _receive(connection: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    counts: dict[str, Counter[str]] = {name: Counter() for name in ("OpenIGTLink", "WebSocket", "UDP")}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams, suppress(EOFError, OSError):
        datagrams.bind((LOOPBACK, 0))
        connection.send(datagrams.getsockname()[1])
        igtl_port, websocket_port = connection.recv()
        for work, at in ((_igtl, igtl_port), (_websocket, websocket_port), (_datagrams, datagrams)):
            threading.Thread(target=work, args=(at, counts), daemon=True).start()
        while True:
            connection.recv()
            connection.send({name: dict(kinds) for name, kinds in counts.items()})


def _igtl(port: int, counts: dict[str, Counter[str]]) -> None:
    with suppress(OSError), socket.create_connection((LOOPBACK, port)) as client, client.makefile("rb") as stream:
        while len(head := stream.read(HEADER.size)) == HEADER.size:
            _, kind, _, _, _, size, _ = HEADER.unpack(head)
            stream.read(size)
            counts["OpenIGTLink"][kind.rstrip(b"\0").decode()] += 1


def _websocket(port: int, counts: dict[str, Counter[str]]) -> None:
    from tubesight.client import results

    with suppress(InputError):
        for _ in results(f"ws://{LOOPBACK}:{port}"):
            counts["WebSocket"]["results"] += 1


def _datagrams(listener: socket.socket, counts: dict[str, Counter[str]]) -> None:
    with suppress(OSError):
        while listener.recv(_DATAGRAM_BYTES):
            counts["UDP"]["results"] += 1


@contextmanager
def browser(address: str, profile: Path) -> Iterator[bool]:
    """Open a page in a browser without a window; whether there is one on the path."""
    program = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if program is None:
        yield False
        return
    # Chromium refuses to run its sandbox as root.
    root = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    process = subprocess.Popen(
        [program, *_BROWSER_FLAGS, *root, f"--user-data-dir={profile}", address],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield True
    finally:
        process.terminate()
        try:
            process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
