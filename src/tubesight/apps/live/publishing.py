"""Subscribers of a live session: network outputs and the viewer."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from tubesight.apps.live.steering import Steering
from tubesight.core import InputError, Status
from tubesight.files.packages import require_package
from tubesight.outputs.network.access import LOOPBACK, Access, is_loopback
from tubesight.outputs.publish import Subscriber
from tubesight.sensor import Reconstruction
from tubesight.tracking.tracker import Tracked


@dataclass(frozen=True, slots=True)
class Place:
    """An address to listen on or to send to."""

    host: str
    port: int

    @classmethod
    def of(cls, text: str) -> Place:
        """Read ``PORT`` (of this machine) or ``HOST:PORT``."""
        host, _, port = text.rpartition(":")
        if not port.isascii() or not port.isdigit() or int(port) > 65535:
            raise InputError(f"{text[:60]!r}: expected a port, or an address and a port as in 127.0.0.1:8765")
        return cls(host.strip("[]") or LOOPBACK, int(port))


@dataclass(frozen=True, slots=True)
class PublishOptions:
    """Where results go.

    Attributes
    ----------
    igtl, websocket
        Where to serve them by OpenIGTLink and as JSON over a WebSocket; None for not at all.
    udp
        Where to send them as datagrams.
    view_port
        Port of the page in the browser, on this machine alone.
    """

    igtl: Place | None = None
    websocket: Place | None = None
    udp: Place | None = None
    view_port: int | None = None


def open_subscribers(options: PublishOptions, steering: Steering) -> tuple[list[Subscriber], list[str]]:
    """Open everything that was asked for, and say what the user should know.

    Parameters
    ----------
    steering
        What can be changed in the viewer.

    Raises
    ------
    InputError
        If a package is missing or a port cannot be opened; nothing stays open then.
    """
    subscribers: list[Subscriber] = []
    messages: list[str] = []
    try:
        if options.igtl or options.websocket or options.udp:
            network = NetworkSubscriber(options)
            subscribers.append(network)
            messages += network.messages
        if options.view_port is not None:
            require_package("viser", "view", "the viewer needs the package viser")
            from tubesight.apps.live.watching import ViewerSubscriber

            viewer = ViewerSubscriber(steering, options.view_port)
            subscribers.append(viewer)
            messages.append(f"open {viewer.address} in a browser on this machine")
    except InputError:
        close(subscribers)
        raise
    return subscribers, messages


def close(subscribers: Sequence[Subscriber]) -> None:
    """Close all."""
    for subscriber in subscribers:
        subscriber.close()


class NetworkSubscriber:
    """Hands live results to the network's thread.

    Parameters
    ----------
    options
        Which outputs.

    Attributes
    ----------
    messages
        Where clients connect, and warnings.
    addresses
        Of each output: ``igtl://...``, ``ws://...``, ``udp://...``.
    """

    def __init__(self, options: PublishOptions) -> None:
        from tubesight.outputs.network.hub import Hub, Sender

        senders: list[Sender] = []
        self.messages: list[str] = []
        if options.igtl is not None:
            require_package("pyigtl", "igtl", "OpenIGTLink needs the package pyigtl")
            from tubesight.outputs.network.igtl_server import IgtlServer

            senders.append(IgtlServer(options.igtl.host, options.igtl.port))
            if not is_loopback(options.igtl.host):
                self.messages.append(f"warning: OpenIGTLink: {Access.to(options.igtl.host).warning}, and no password")
        if options.websocket is not None:
            require_package("websockets", "stream", "the WebSocket needs the package websockets")
            from tubesight.outputs.network.websocket import WebSocketServer

            access = Access.to(options.websocket.host)
            senders.append(WebSocketServer(access, options.websocket.port))
            if access.warning:
                self.messages.append(f"warning: WebSocket: {access.warning}; clients need the token")
        if options.udp is not None:
            from tubesight.outputs.network.udp import UdpSender

            senders.append(UdpSender(options.udp.host, options.udp.port))
            if not is_loopback(options.udp.host):
                self.messages.append(f"warning: datagrams leave this machine for {options.udp.host}, not encrypted")
        self._hub = Hub(senders)
        self._hub.__enter__()
        self.addresses = [sender.address for sender in senders]
        self.messages += [f"results: {address}" for address in self.addresses]

    def publish(self, tracked: Tracked) -> None:
        """Hand a result over; returns at once."""
        self._hub.publish(result_of(tracked), wall_time_s(tracked))

    def close(self) -> None:
        """Hang up."""
        self._hub.__exit__()


def result_of(tracked: Tracked) -> Reconstruction:
    """Return the result of a moment; that of a fault has no numbers."""
    if tracked.result is not None:
        return tracked.result
    notes = tracked.notes or (tracked.state.meaning,)
    return Reconstruction(str(tracked.state), Status.BAD_IMAGE, notes, None, None, {}, "")


def wall_time_s(tracked: Tracked) -> float:
    """Seconds since 1970 of a moment: the cameras' clock is the machine's monotonic one."""
    return time.time() - (time.monotonic() - tracked.time_s)
