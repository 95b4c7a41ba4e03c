"""OpenIGTLink server: many clients get every result; what a client sends is distrusted, and none waits for another."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import time
from typing import Any

from pyigtl.messages import CRC64

from tubesight.outputs.network.access import checked_port
from tubesight.outputs.network.igtl_messages import PLAIN, WITH_METADATA, pack_result, pack_status

PORT = 18944
# Header of every message: version, type, device, time stamp (2), size of the body, checksum.
HEADER = struct.Struct("> H 12s 20s II Q Q")
_VERSIONS = (1, 2, 3)
# Clients only ask short questions.
_BODY_BYTES = 1 << 16
# A message that was begun has to arrive within this time, and what is sent has to be taken: else the client is dropped.
_PATIENCE_S = 2.0
_WATCH_S = 0.25
# Unsent bytes of a slow client: half a second at 200 results a second of 3 kB, and as much in the system's buffer.
_WAITING_BYTES = 1 << 18
CLIENTS_MAX = 16


class IgtlServer:
    """Sends results to OpenIGTLink clients (`tubesight.outputs.network.hub.Sender`).

    Clients get plain headers, which every library reads, until they send a message with a header of version 2 or
    more: then they get metadata too. The protocol knows no passwords: on another address than loopback everybody who
    reaches the port can read along.

    Parameters
    ----------
    host, port
        Where to listen; port 0 takes any free one.

    Attributes
    ----------
    dropped
        How many clients were dropped, by reason.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = PORT) -> None:
        self.host, self.port = host, checked_port(port, "OpenIGTLink")
        self.dropped: dict[str, int] = {}
        self.clients: set[_Client] = set()
        self.state = pack_status(True, "", "no result yet", time.time())
        self._server: asyncio.Server | None = None
        self._watch: asyncio.Task[None] | None = None

    @property
    def address(self) -> str:
        """Where clients connect."""
        return f"OpenIGTLink {self.host}:{self.port}"

    async def start(self) -> None:
        """Open the port."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Client(self), self.host, self.port)
        self.port = self._server.sockets[0].getsockname()[1]
        self._watch = loop.create_task(self._drop_stuck())

    def send(self, message: dict[str, Any]) -> None:
        """Send a result to all clients."""
        time_s = time.time() if message["time_s"] is None else message["time_s"]
        self.state = pack_status(message["status"] == "ok", message["status"], "; ".join(message["notes"]), time_s)
        packed = {version: pack_result(message, time_s, version) for version in {c.version for c in self.clients}}
        for client in tuple(self.clients):
            client.send(packed[client.version])

    async def stop(self) -> None:
        """Hang up."""
        if self._watch is not None:
            self._watch.cancel()
        if self._server is not None:
            self._server.close()
        for client in tuple(self.clients):
            client.transport.abort()

    async def _drop_stuck(self) -> None:
        while True:
            await asyncio.sleep(_WATCH_S)
            for client in tuple(self.clients):
                client.check()


class _Client(asyncio.Protocol):
    """One connection."""

    transport: asyncio.Transport

    def __init__(self, server: IgtlServer) -> None:
        self.version = PLAIN
        self._server = server
        self._received = bytearray()
        self._begun_s: float | None = None
        self._waiting_s: float | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        if len(self._server.clients) >= CLIENTS_MAX:
            self._drop("too many clients")
            return
        self._server.clients.add(self)
        _tune(transport.get_extra_info("socket"))

    def connection_lost(self, exc: Exception | None) -> None:
        self._server.clients.discard(self)

    def data_received(self, data: bytes) -> None:
        self._received += data
        while len(self._received) >= HEADER.size and not self.transport.is_closing():
            version, kind, _, _, _, size, checksum = HEADER.unpack_from(self._received)
            if version not in _VERSIONS or not kind.rstrip(b"\0").replace(b"_", b"").isalnum():
                self._drop("not OpenIGTLink")
                return
            if size > _BODY_BYTES:
                self._drop("message too large")
                return
            end = HEADER.size + size
            if len(self._received) < end:
                break
            body = bytes(self._received[HEADER.size : end])
            del self._received[:end]
            if CRC64(body) != checksum:
                self._drop("wrong checksum")
                return
            self.version = max(self.version, min(version, WITH_METADATA))
            if kind.rstrip(b"\0") == b"GET_STATUS":
                self.send(self._server.state)
        self._begun_s = (self._begun_s or time.monotonic()) if self._received else None

    def send(self, packed: bytes) -> None:
        """Send bytes, or drop a client that does not take them."""
        if not self.transport.is_closing():
            self.transport.write(packed)
            self.check()

    def check(self) -> None:
        """Drop the client if it sends too slowly, or takes too little."""
        now = time.monotonic()
        if self._begun_s is not None and now - self._begun_s > _PATIENCE_S:
            self._drop("message not finished")
        waiting = self.transport.get_write_buffer_size()
        self._waiting_s = (self._waiting_s or now) if waiting else None
        if waiting > _WAITING_BYTES or (self._waiting_s is not None and now - self._waiting_s > _PATIENCE_S):
            self._drop("too slow")

    def _drop(self, reason: str) -> None:
        if not self.transport.is_closing():
            self._server.dropped[reason] = self._server.dropped.get(reason, 0) + 1
            self.transport.abort()
        self._server.clients.discard(self)


def _tune(connection: socket.socket) -> None:
    """Send at once, keep little in the system's buffer, and notice a machine that is gone within 3 s."""
    options = [
        (socket.IPPROTO_TCP, "TCP_NODELAY", 1),
        (socket.SOL_SOCKET, "SO_SNDBUF", _WAITING_BYTES),
        (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),
        (socket.IPPROTO_TCP, "TCP_KEEPIDLE", 1),
        (socket.IPPROTO_TCP, "TCP_KEEPINTVL", 1),
        (socket.IPPROTO_TCP, "TCP_KEEPCNT", 2),
        (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", 2500),
    ]
    for level, name, value in options:
        if hasattr(socket, name):
            with contextlib.suppress(OSError):
                connection.setsockopt(level, getattr(socket, name), value)
