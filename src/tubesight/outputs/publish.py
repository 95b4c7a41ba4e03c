"""Where live results go: subscribers that never make the measurement wait."""

from __future__ import annotations

import threading
from typing import Generic, Protocol, TypeVar

from tubesight.tracking.tracker import Tracked

T = TypeVar("T")


class Subscriber(Protocol):
    """Takes live results. `publish` returns at once, whatever becomes of them."""

    def publish(self, tracked: Tracked) -> None:
        """Take one result; called by the measuring thread, must neither block nor raise."""

    def close(self) -> None:
        """Finish; may take up to a second."""


class Slot(Generic[T]):
    """One place for another thread to empty: the newest thing put there, older ones are replaced."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: T | None = None
        self._closed = False

    def put(self, thing: T) -> None:
        """Put something into the slot, in the place of what was not taken yet; returns at once."""
        with self._changed:
            self._newest = thing
            self._changed.notify_all()

    def take(self, timeout_s: float | None) -> T | None:
        """Wait for what was not taken yet; None where nothing comes in time or the slot is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._closed, timeout_s)
            newest, self._newest = self._newest, None
            return newest

    def close(self) -> None:
        """Wake whoever waits."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Mailbox(Slot[Tracked]):
    """A subscriber whose results another thread takes."""

    def publish(self, tracked: Tracked) -> None:
        """Put a result into the slot."""
        self.put(tracked)
