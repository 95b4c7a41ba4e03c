"""Network cameras: pictures or motion JPEG over HTTP."""

from __future__ import annotations

import time

from tubesight.sources.buffers import PictureBuffers
from tubesight.sources.clock import ArrivalClock
from tubesight.sources.http import HttpPictures
from tubesight.sources.jpeg import decode_picture
from tubesight.sources.reader import Picture, Source, Wanted

# A picture is decoded at least after so many, also where more always wait.
_SKIP_MAX = 2


class _HttpReader:
    def __init__(self, url: str, wanted: Wanted) -> None:
        self._stream = HttpPictures(url, wanted.timeout_s)
        self._gray = wanted.gray
        self._clock, self._buffers = ArrivalClock(), PictureBuffers()

    def read(self) -> Picture:
        data = self._stream.read()
        time_s = self._clock.time_s(self._stream.stamp_s, time.monotonic())
        skipped = 0
        # Pictures that wait in the network are old: reading them is quick, decoding is not.
        while self._stream.more_waits() and skipped < _SKIP_MAX:
            data = self._stream.read()
            time_s = self._clock.time_s(self._stream.stamp_s, time.monotonic())
            skipped += 1
        image = decode_picture(data, self._stream.name, self._gray, self._buffers)
        return Picture(image, time_s, data, skipped)

    def close(self) -> None:
        self._stream.close()


def http_source(url: str, wanted: Wanted) -> Source:
    """Motion JPEG, or one picture each time, over HTTP; stamped ``X-Timestamp`` by the server where it does."""
    return Source(HttpPictures(url, wanted.timeout_s).name, lambda: _HttpReader(url, wanted))
