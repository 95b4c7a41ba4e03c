"""Sending results over the network from a thread of its own, so that no client can hold up the measurement."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Sequence
from typing import Any, Protocol

from tubesight.core import InputError
from tubesight.outputs.network.messages import result_message
from tubesight.sensor import Reconstruction

# Longest time to start or to stop all servers.
_PATIENCE_S = 5.0


class Sender(Protocol):
    """A way to send messages; its methods run in the hub's thread."""

    @property
    def address(self) -> str:
        """Where clients connect or messages go, for people to read."""

    async def start(self) -> None:
        """Open the port; raise `OSError` where it is not free."""

    def send(self, message: dict[str, Any]) -> None:
        """Send one message (`result_message`) without waiting for anybody."""

    async def stop(self) -> None:
        """Close all connections and the port."""


class Hub:
    """Sends each result to all senders. Use it as a context manager.

    `publish` never waits: results that come faster than they are sent replace each other, the newest is kept.

    Parameters
    ----------
    senders
        What sends the messages.

    Attributes
    ----------
    replaced
        How many results were replaced by newer ones before they were sent.

    Raises
    ------
    InputError
        On entering, if a port cannot be opened.
    """

    def __init__(self, senders: Sequence[Sender]) -> None:
        self.senders = tuple(senders)
        self.replaced = 0
        self._number = 0
        self._lock = threading.Lock()
        self._slot: tuple[Reconstruction, int, float] | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="network", daemon=True)

    def __enter__(self) -> Hub:
        self._thread.start()
        for sender in self.senders:
            try:
                asyncio.run_coroutine_threadsafe(sender.start(), self._loop).result(_PATIENCE_S)
            except OSError as error:
                self.__exit__()
                reason = error.strerror or str(error)
                raise InputError(
                    f"{sender.address}: cannot be opened ({reason}); choose another port, or end what uses it"
                ) from error
        return self

    def __exit__(self, *_: object) -> None:
        for sender in self.senders:
            with contextlib.suppress(OSError, TimeoutError, RuntimeError):
                asyncio.run_coroutine_threadsafe(sender.stop(), self._loop).result(_PATIENCE_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_PATIENCE_S)
        if not self._thread.is_alive():
            self._loop.close()

    @property
    def idle(self) -> bool:
        """Whether every result handed over was sent or replaced."""
        with self._lock:
            return self._slot is None

    def publish(self, result: Reconstruction, time_s: float = float("nan")) -> None:
        """Hand over a result; returns at once."""
        with self._lock:
            waiting = self._slot is not None
            self._slot = (result, self._number, time_s)
            self._number += 1
            self.replaced += waiting
        if not waiting:
            self._loop.call_soon_threadsafe(self._send)

    def _send(self) -> None:
        with self._lock:
            slot, self._slot = self._slot, None
        if slot is not None:
            message = result_message(*slot)
            for sender in self.senders:
                sender.send(message)
