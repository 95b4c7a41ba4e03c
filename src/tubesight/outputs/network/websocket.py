"""Results as JSON over WebSocket, one a message, and their schema."""

from __future__ import annotations

import asyncio
import contextlib
import http
import json
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.http11 import Request, Response

from tubesight.files.message import dump_message, message_schema
from tubesight.outputs.network.access import CONNECTIONS, Access, checked_port

PORT = 8765
CLIENTS_MAX = 16
# Clients of a WebSocket only answer pings.
_RECEIVED_BYTES = 1 << 10
# A client that does not answer a ping in this time is gone.
_PING_S = 1.5
# Unsent bytes of a slow client: half a second at 200 results a second of 3 kB.
_WAITING_BYTES = 1 << 18
_SCHEMA_PATH = "/schema.json"


class WebSocketServer:
    """Sends results to WebSocket clients (`tubesight.outputs.network.hub.Sender`); serves their schema too.

    Parameters
    ----------
    access
        Where to listen, and who is let in.
    port
        0 takes any free one.

    Attributes
    ----------
    dropped
        How many clients were dropped because they took too little.
    """

    def __init__(self, access: Access, port: int = PORT) -> None:
        self.access, self.port = access, checked_port(port, "WebSocket")
        self.dropped = 0
        self._last = ""
        self._server: Server | None = None

    @property
    def address(self) -> str:
        """Where clients connect."""
        token = f"?token={self.access.token}" if self.access.token else ""
        return f"ws://{self.access.host}:{self.port}/{token}"

    async def start(self) -> None:
        """Open the port."""
        self._server = await serve(
            self._stay,
            self.access.host,
            self.port,
            process_request=self._check,
            max_size=_RECEIVED_BYTES,
            ping_interval=_PING_S,
            ping_timeout=_PING_S,
            compression=None,
            server_header=None,
            logger=CONNECTIONS,
            write_limit=_WAITING_BYTES,
        )
        self.port = next(iter(self._server.sockets)).getsockname()[1]

    def send(self, message: dict[str, Any]) -> None:
        """Send a result to all clients."""
        self._last = dump_message(message)
        if self._server is None:
            return
        for client in tuple(self._server.connections):
            if client.transport.get_write_buffer_size() > _WAITING_BYTES:
                self.dropped += 1
                client.transport.abort()
            elif client.state.name == "OPEN":
                # Only what the transport's buffer takes: there is nothing to wait for.
                asyncio.get_running_loop().create_task(_send(client, self._last))

    async def stop(self) -> None:
        """Hang up."""
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    async def _stay(self, client: ServerConnection) -> None:
        """Begin with the last result, then read and forget what the client says until it leaves."""
        if self._last:
            await _send(client, self._last)
        async for _ in client:
            pass

    def _check(self, client: ServerConnection, request: Request) -> Response | None:
        headers = request.headers
        values = [headers.get_all(name) for name in ("Host", "Origin", "Authorization")]
        if any(len(value) > 1 for value in values):
            return client.respond(http.HTTPStatus.BAD_REQUEST, "a header is there twice\n")
        host, origin, authorization = (value[0] if value else None for value in values)
        refusal = self.access.refusal(host, origin, request.path, authorization)
        if refusal:
            return client.respond(http.HTTPStatus.FORBIDDEN, f"{refusal}\n")
        if request.path.partition("?")[0] == _SCHEMA_PATH:
            response = client.respond(http.HTTPStatus.OK, json.dumps(message_schema(), indent=1) + "\n")
            del response.headers["Content-Type"]
            response.headers["Content-Type"] = "application/schema+json"
            return response
        if self._server is not None and len(self._server.connections) >= CLIENTS_MAX:
            return client.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "too many clients\n")
        return None


async def _send(client: ServerConnection, text: str) -> None:
    with contextlib.suppress(Exception):  # a client that is gone is no news
        await client.send(text)
