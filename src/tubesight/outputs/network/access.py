"""Who may connect: this machine alone, unless another address is asked for; then a token and a warning."""

from __future__ import annotations

import hmac
import ipaddress
import logging
import secrets
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

from tubesight.core import InputError

LOOPBACK = "127.0.0.1"
#: Where servers tell of connections: nowhere. Browsers open some beforehand and close them unused, scanners send
#: anything, and neither is worth a traceback on the terminal.
CONNECTIONS = logging.getLogger("tubesight.connections")
CONNECTIONS.addHandler(logging.NullHandler())
CONNECTIONS.propagate = False
# Bytes of randomness in a token: 128 bits cannot be guessed.
_TOKEN_BYTES = 16


def is_loopback(host: str) -> bool:
    """Whether an address or name is this machine's own and cannot be reached from elsewhere."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def checked_port(port: int, name: str) -> int:
    """Return a port; raise `InputError` where it is none. 0 lets the system choose."""
    if not 0 <= port <= 65535:
        raise InputError(f"{name}: {port} is no port; use 1024 to 65535, or 0 for any free one")
    return port


@dataclass(frozen=True, slots=True)
class Access:
    """Rule for web connections to one server.

    Attributes
    ----------
    host
        Address the server listens on.
    token
        What a client has to send, empty for none: a server that others can reach always has one.
    """

    host: str = LOOPBACK
    token: str = ""

    @classmethod
    def to(cls, host: str) -> Access:
        """Rule for a server on an address: with a new token where others can reach it."""
        return cls(host, "" if is_loopback(host) else secrets.token_urlsafe(_TOKEN_BYTES))

    @property
    def warning(self) -> str:
        """What to tell the user, empty on loopback."""
        if is_loopback(self.host):
            return ""
        return f"listening on {self.host}: every machine that reaches it can try to connect, and nothing is encrypted"

    def refusal(self, host: str | None, origin: str | None, target: str, authorization: str | None) -> str:
        """Why a request is refused, empty where it is let in.

        A page of another site that a browser on this machine has open may connect to loopback too, under its own name
        (Origin) or under a name that it lets point here (Host): both have to be this server's.

        Parameters
        ----------
        host, origin, authorization
            The request's headers.
        target
            Path and query; the token may come as ``?token=...`` or as ``Authorization: Bearer ...``.
        """
        name = _name_of(f"//{host}") if host else ""
        if not self._is_own(name):
            return "the name in the address is not this server's"
        if origin is not None and not self._is_own(_name_of(origin)):
            return "pages of other sites may not connect"
        if self.token:
            given = parse_qs(urlsplit(target).query).get("token", [""])[0]
            if authorization and authorization.startswith("Bearer "):
                given = authorization.removeprefix("Bearer ")
            if not hmac.compare_digest(given.encode(), self.token.encode()):
                return "the token is missing or wrong"
        return ""

    def _is_own(self, name: str) -> bool:
        if is_loopback(name):
            return True
        # On all addresses the server cannot know its own names; numbers cannot be made to point here by others.
        return name == self.host or (not is_loopback(self.host) and _is_number(name))


def _name_of(address: str) -> str:
    try:
        return urlsplit(address).hostname or ""
    except ValueError:
        return ""


def _is_number(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
