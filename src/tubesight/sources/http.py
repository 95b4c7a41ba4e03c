"""Pictures over HTTP: motion JPEG (``multipart/x-mixed-replace``) and single pictures, with limits on time and size."""

from __future__ import annotations

import base64
import re
import select
import time
import urllib.error
import urllib.parse
import urllib.request
from http.client import HTTPException, HTTPResponse

from tubesight.core import InputError

# A part's headers, and a compressed picture: 65 megapixels take 20 MB at the best JPEG quality.
_HEADER_BYTES = 8192
_PICTURE_BYTES = 32 << 20
_CHUNK_BYTES = 1 << 16
_BOUNDARY = re.compile(r'boundary="?([^";,]+)"?', re.IGNORECASE)
_LENGTH = re.compile(rb"^content-length:\s*(\d{1,12})\s*$", re.IGNORECASE | re.MULTILINE)
_STAMP = re.compile(rb"^x-timestamp:\s*(\d{1,12}(?:\.\d{1,9})?)\s*$", re.IGNORECASE | re.MULTILINE)
_END_OF_HEADERS = re.compile(rb"\r?\n\r?\n")


class HttpPictures:
    """Pictures of one address, one after the other, as the bytes the camera sent.

    Parameters
    ----------
    url
        ``http://`` or ``https://``, may carry ``user:password@`` (sent as basic authentication).
    timeout_s
        Longest time to connect, and for one picture to arrive whole.

    Raises
    ------
    InputError
        If the address cannot be used, nothing answers, or what comes is no picture.
    """

    def __init__(self, url: str, timeout_s: float) -> None:
        parts = urllib.parse.urlsplit(url)
        try:
            host, port = parts.hostname, parts.port
        except ValueError:
            host, port = None, None
        if parts.scheme not in ("http", "https") or not host:
            raise InputError(f"{url[:80]}: not an address of a camera; expected for example http://192.168.0.10/video")
        netloc = host if ":" not in host else f"[{host}]"
        netloc += f":{port}" if port else ""
        self.name = urllib.parse.urlunsplit((parts.scheme, netloc, parts.path, parts.query, ""))
        self._timeout_s = timeout_s
        self._headers = {"Accept": "multipart/x-mixed-replace, image/jpeg"}
        if parts.username is not None:
            login = f"{urllib.parse.unquote(parts.username)}:{urllib.parse.unquote(parts.password or '')}"
            self._headers["Authorization"] = f"Basic {base64.b64encode(login.encode()).decode()}"
        self._response: HTTPResponse | None = None
        self._boundary: bytes | None = None
        self._buffer = bytearray()
        self._deadline = 0.0
        #: When the last picture was taken, seconds of the server's clock (header ``X-Timestamp``); NaN without.
        self.stamp_s = float("nan")

    def read(self) -> bytes:
        """Return the next picture; raise `InputError` where none arrives whole in time."""
        self._deadline = time.monotonic() + self._timeout_s
        try:
            if self._response is None:
                self._open()
            if self._boundary is None:
                picture = self._all()
                self.close()
                return picture
            return self._part()
        except (OSError, HTTPException) as error:
            self.close()
            if isinstance(error, urllib.error.HTTPError):
                error.close()
            raise InputError(f"{self.name}: {self._reason(error)}") from error
        except InputError:
            self.close()
            raise

    def more_waits(self) -> bool:
        """Whether the next picture of a stream has begun to arrive."""
        if self._response is None or self._boundary is None:
            return False
        try:
            if not self._response.isclosed() and select.select([self._response], [], [], 0.0)[0]:
                self._buffer += self._response.read1(_CHUNK_BYTES)
        except (OSError, ValueError, HTTPException):
            return False
        # The line end behind a picture and the next delimiter may come with the picture; headers come with the next.
        place = self._buffer.find(self._boundary)
        head = _END_OF_HEADERS.search(self._buffer, place) if place >= 0 else None
        return head is not None and head.end() < len(self._buffer)

    def close(self) -> None:
        """Hang up."""
        if self._response is not None:
            self._response.close()
        self._response, self._buffer = None, bytearray()

    def _reason(self, error: Exception) -> str:
        if isinstance(error, urllib.error.HTTPError):
            login = "; give user and password as http://user:password@..." if error.code == 401 else ""
            return f"the camera answers {error.code} {error.reason}; check the address{login}"
        cause = error.reason if isinstance(error, urllib.error.URLError) else error
        if isinstance(cause, TimeoutError):
            return f"no answer for {self._timeout_s:g} s; is the camera on, and the address right?"
        text = getattr(cause, "strerror", None) or str(cause) or type(cause).__name__
        return f"cannot be read ({text}); is the camera on, and the address right?"

    def _open(self) -> None:
        # A lab's cameras are on its own network, where a proxy for the Internet would not find them.
        opener = urllib.request.OpenerDirector()
        for handler in (
            urllib.request.HTTPHandler,
            urllib.request.HTTPSHandler,
            urllib.request.HTTPRedirectHandler,
            urllib.request.HTTPErrorProcessor,
            urllib.request.HTTPDefaultErrorHandler,
        ):
            opener.add_handler(handler())
        response = opener.open(urllib.request.Request(self.name, headers=self._headers), timeout=self._timeout_s)
        if not isinstance(response, HTTPResponse):
            raise InputError(f"{self.name}: does not lead to a camera; check the address")
        self._response = response
        kind = response.headers.get("Content-Type", "")
        if kind.lower().startswith("multipart/"):
            found = _BOUNDARY.search(kind)
            if found is None:
                raise InputError(f"{self.name}: the stream names no boundary between its pictures; is it motion JPEG?")
            # Some cameras write the two dashes of the delimiter into the boundary too.
            self._boundary = b"--" + found[1].strip().removeprefix("--").encode("latin-1", "replace")
        elif kind.lower().startswith("image/"):
            self._boundary = None
        else:
            raise InputError(
                f"{self.name}: sends {kind[:40] or 'something unnamed'!r}, not motion JPEG or a picture; "
                "look for the camera's stream address in its manual"
            )

    def _fill(self) -> bool:
        """Take more bytes; False at the end of the stream."""
        if time.monotonic() > self._deadline or self._response is None:
            raise TimeoutError
        more = self._response.read1(_CHUNK_BYTES)
        self._buffer += more
        return bool(more)

    def _all(self) -> bytes:
        while self._fill():
            if len(self._buffer) > _PICTURE_BYTES:
                raise InputError(
                    f"{self.name}: the picture is larger than {_PICTURE_BYTES >> 20} MiB; use a smaller one"
                )
        return bytes(self._buffer)

    def _part(self) -> bytes:
        """Take the next part of the stream: delimiter, headers, picture."""
        boundary = self._boundary or b""
        start = self._find(boundary, _PICTURE_BYTES) + len(boundary)
        del self._buffer[:start]
        found = None
        while found is None:
            found = _END_OF_HEADERS.search(self._buffer, 0, _HEADER_BYTES)
            if found is None and (len(self._buffer) > _HEADER_BYTES or not self._fill()):
                raise InputError(f"{self.name}: the stream ends or is no motion JPEG; check the address")
        head = bytes(self._buffer[: found.start()])
        length, stamp = _LENGTH.search(head), _STAMP.search(head)
        self.stamp_s = float(stamp[1]) if stamp is not None else float("nan")
        del self._buffer[: found.end()]
        size = int(length[1]) if length is not None else self._find(b"\r\n" + boundary, _PICTURE_BYTES)
        if size > _PICTURE_BYTES:
            raise InputError(f"{self.name}: a picture of {size} bytes is announced; use smaller pictures")
        while len(self._buffer) < size:
            if not self._fill():
                raise InputError(f"{self.name}: the stream broke off within a picture; is the camera still on?")
        picture = bytes(self._buffer[:size])
        del self._buffer[:size]
        return picture

    def _find(self, what: bytes, limit: int) -> int:
        """Place of some bytes in the stream ahead."""
        searched = 0
        while (place := self._buffer.find(what, searched)) < 0:
            if len(self._buffer) > limit:
                raise InputError(f"{self.name}: no end of the picture within {limit >> 20} MiB; is it motion JPEG?")
            searched = max(len(self._buffer) - len(what), 0)
            if not self._fill():
                raise InputError(f"{self.name}: the stream ended; is the camera still on?")
        return place
