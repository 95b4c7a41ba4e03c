"""A page in the browser that a thread of its own keeps up to date."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import Generic, Self, TypeVar

from tubesight.apps.viewer.guard import open_server
from tubesight.outputs.publish import Slot

T = TypeVar("T")


class Page(ABC, Generic[T]):
    """Opens a port, and shows what is put into its slot while it is used as a context manager.

    Parameters
    ----------
    port
        On this machine; 0 takes any free one.
    name
        Of the thread.

    Attributes
    ----------
    server
        What serves the page.
    """

    def __init__(self, port: int, name: str) -> None:
        self.server = open_server(port)
        self._slot: Slot[T] = Slot()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._slot.close()
        self._thread.join(2.0)
        self.server.stop()

    @abstractmethod
    def _run(self) -> None:
        """Show what comes until `_ended` is set."""
