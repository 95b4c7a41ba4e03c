"""Results as JSON, one a datagram."""

from __future__ import annotations

import asyncio
from typing import Any

from tubesight.files.message import dump_message
from tubesight.outputs.network.access import checked_port

PORT = 8766


class UdpSender:
    """Sends results as datagrams to one address (`tubesight.outputs.network.hub.Sender`).

    Parameters
    ----------
    host, port
        Where to.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = PORT) -> None:
        self.host, self.port = host, checked_port(port, "UDP")
        self._transport: asyncio.DatagramTransport | None = None

    @property
    def address(self) -> str:
        """Where messages go."""
        return f"udp://{self.host}:{self.port}"

    async def start(self) -> None:
        """Open a socket of our own; whether anybody listens is not known."""
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(
            asyncio.DatagramProtocol, remote_addr=(self.host, self.port)
        )

    def send(self, message: dict[str, Any]) -> None:
        """Send a result."""
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(dump_message(message).encode())

    async def stop(self) -> None:
        """Close the socket."""
        if self._transport is not None:
            self._transport.close()
