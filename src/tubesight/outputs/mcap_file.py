"""Writing an MCAP file so that what was written is readable whenever the writer stops."""

from __future__ import annotations

import time
from contextlib import suppress
from io import BufferedWriter
from pathlib import Path
from types import TracebackType

from tubesight import __version__
from tubesight.core import InputError
from tubesight.files.recording import IMAGE_SCHEMA, JSON_SCHEMA, PICTURE_TOPIC, need_mcap

# What a crash may lose: the chunk in the making is written out this often.
FLUSH_S = 0.3


class McapFile:
    """A recording in the making.

    A write that fails (a full disk) cuts the file back to its last whole chunk, so that it stays readable.

    Parameters
    ----------
    path
        Has to be new.

    Raises
    ------
    InputError
        If it is there already or cannot be made.
    """

    def __init__(self, path: Path) -> None:
        need_mcap(str(path))
        from mcap.writer import CompressionType, Writer

        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: BufferedWriter = path.open("xb")
        except FileExistsError:
            raise InputError(f"{path}: is there already; name a new file") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
        # Pixels with noise: 5 ms a picture of 2 MB, where zstd takes 15 ms and saves a third more.
        self._writer = Writer(self._stream, compression=CompressionType.LZ4)
        self.path = path
        self._channels: dict[str, int] = {}
        self._good = self.bytes = 0
        self._flushed_s = time.monotonic()
        self._writer.start(profile="", library=f"tubesight {__version__}")

    def write(self, topic: str, time_ns: int, number: int, data: bytes) -> None:
        """Add a message; raise `OSError` where the disk does not take it (the file is then closed)."""
        try:
            self._writer.add_message(self._channel(topic), time_ns, data, time_ns, number & 0xFFFFFFFF)
            if time.monotonic() - self._flushed_s > FLUSH_S:
                self.flush()
        except OSError:
            self._cut()
            raise

    def flush(self) -> None:
        """Hand everything to the system: from here on only a crash of the machine loses it."""
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._good = self.bytes = self._stream.tell()
            self._flushed_s = time.monotonic()
        except OSError:
            self._cut()
            raise

    def close(self) -> None:
        """Write the index and close; raise `OSError` where the disk does not take it (the rest stays readable)."""
        if self._stream.closed:
            return
        self.flush()
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.close()
        except OSError:
            self._cut()
            raise

    def __enter__(self) -> McapFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _cut(self) -> None:
        raw = self._stream.raw
        if raw.closed:
            return
        with suppress(OSError):
            raw.truncate(self._good)
        # The buffer that could not be written must not be tried again on closing: the file below it goes first.
        with suppress(OSError):
            raw.close()
        with suppress(OSError, ValueError):
            self._stream.close()

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            if topic.startswith(PICTURE_TOPIC):
                schema = self._writer.register_schema(
                    "sensor_msgs/msg/CompressedImage", "ros2msg", IMAGE_SCHEMA.encode()
                )
                self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
            else:
                schema = self._writer.register_schema(topic.rpartition("/")[2], "jsonschema", JSON_SCHEMA.encode())
                self._channels[topic] = self._writer.register_channel(topic, "json", schema)
        return self._channels[topic]
