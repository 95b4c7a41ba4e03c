"""A `viser` server that listens on this machine alone and lets in nobody else's pages."""

from __future__ import annotations

import http
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import rich
import viser
from websockets.asyncio import server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from tubesight.core import InputError
from tubesight.outputs.network.access import CONNECTIONS, LOOPBACK, Access, checked_port

PORT = 8080

# viser prints through rich's own console; what users need to know the commands print.
rich.get_console().quiet = True

Check = Callable[[ServerConnection, Request], Any]


class LocalServer(viser.ViserServer):
    """A server that no page can ask to connect to viser's public relay."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: pictures stay on this machine."""


def open_server(port: int = PORT) -> LocalServer:
    """Open the viewer's port on loopback.

    The viewer controls the measurement and shows pictures, and viser has no passwords: it is never opened to others.
    From another machine it is reached through ``ssh -L``.

    Raises
    ------
    InputError
        If the port is taken; viser itself would silently take another one.
    """
    checked_port(port, "viewer")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise InputError(
                f"viewer {LOOPBACK}:{port}: cannot be opened ({error.strerror}); choose another port"
            ) from error
    with _guarded(Access()):
        return LocalServer(LOOPBACK, port, label="tubesight", verbose=False)


@contextmanager
def _guarded(access: Access) -> Iterator[None]:
    """Have servers that are opened meanwhile check each request's Host and Origin: viser has no setting for it."""
    serve = websocket_server.serve
    websocket_server.serve = partial(_serve_checked, serve, access)  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websocket_server.serve = serve  # type: ignore[misc]


def _serve_checked(serve: Callable[..., Any], access: Access, *args: Any, process_request: Check, **named: Any) -> Any:
    def check(connection: ServerConnection, request: Request) -> Response | Any:
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or len(origins) > 1:
            return connection.respond(http.HTTPStatus.BAD_REQUEST, "one Host, at most one Origin\n")
        refusal = access.refusal(hosts[0], origins[0] if origins else None, request.path, None)
        # The page steers the measurement and has files written: other programs' pages on this machine may not either.
        if origins and origins[0] != f"http://{hosts[0]}":
            refusal = "pages of other sites may not connect"
        return (
            connection.respond(http.HTTPStatus.FORBIDDEN, f"{refusal}\n")
            if refusal
            else process_request(connection, request)
        )

    return serve(*args, process_request=check, **{**named, "logger": CONNECTIONS})
