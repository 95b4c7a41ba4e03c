"""Recordings: MCAP files with configuration, pictures and results; read also where the writer was cut off."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tubesight.core import InputError
from tubesight.files.packages import require_package

FORMAT = "tubesight-recording/1"
CONFIGURATION_TOPIC = "/tubesight/configuration"
RESULT_TOPIC = "/tubesight/result"
PICTURE_TOPIC = "/camera/"
# A record is a chunk of about a MiB, or one picture of 100 megapixels in PNG; a damaged length is not believed.
_RECORD_BYTES = 512 << 20

# As ROS 2 defines sensor_msgs/msg/CompressedImage, so that other tools show the pictures.
IMAGE_SCHEMA = """std_msgs/Header header
string format
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
JSON_SCHEMA = json.dumps({"type": "object"})


@dataclass(frozen=True, slots=True, eq=False)
class RecordedPicture:
    """One picture of a recording.

    Attributes
    ----------
    camera, number
        Name, and count of the camera's pictures.
    time_ns
        When it was taken, nanoseconds since 1970.
    data
        The coded picture, with its format (``jpeg`` or ``png``).
    """

    camera: str
    number: int
    time_ns: int
    format: str
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class RecordedResult:
    """What was published of one moment, as plain data."""

    time_ns: int
    data: dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSwitch:
    """The configuration again, with what was changed while it ran: it made the results that follow."""

    time_ns: int
    configuration: dict[str, Any]


Entry = RecordedPicture | RecordedResult | RecordedSwitch


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One message of a recording as it lies in the file."""

    topic: str
    time_ns: int
    number: int
    data: bytes


def need_mcap(what: str) -> None:
    """Refuse where the package for recordings is missing."""
    require_package("mcap", "record", f"{what}: recordings need the package mcap")


def coded_image(time_ns: int, camera: str, form: str, data: bytes) -> bytes:
    """Serialise a ``sensor_msgs/msg/CompressedImage`` (CDR, little endian)."""

    def text(value: str) -> bytes:
        raw = value.encode() + b"\0"
        return struct.pack("<I", len(raw)) + raw + bytes(-len(raw) % 4)

    head = struct.pack("<4xiI", time_ns // 10**9, time_ns % 10**9)
    return b"\0\1" + head[2:] + text(camera) + text(form) + struct.pack("<I", len(data)) + data


def decoded_image(message: bytes) -> tuple[str, bytes]:
    """Format and data of a serialised ``CompressedImage``; raise `ValueError` where it is none."""
    at = 12
    values = []
    for _ in range(2):
        (length,) = struct.unpack_from("<I", message, at)
        values.append(message[at + 4 : at + 3 + length])
        at += 4 + length + -length % 4
    (length,) = struct.unpack_from("<I", message, at)
    data = message[at + 4 : at + 4 + length]
    if len(data) < length:
        raise ValueError("cut off")
    return values[1].decode("utf-8", "replace"), data


def read_messages(path: Path) -> Iterator[Message]:
    """Messages of an MCAP file in the order written, as far as the file is whole.

    Raises
    ------
    InputError
        If it is no MCAP file.
    """
    need_mcap(str(path))
    from mcap.exceptions import McapError
    from mcap.records import Channel
    from mcap.records import Message as Record
    from mcap.stream_reader import StreamReader

    try:
        stream = path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    with stream:
        if stream.read(8) != b"\x89MCAP0\r\n":
            raise InputError(f"{path}: not a recording; name a .mcap file that `tubesight live --record` wrote")
        stream.seek(0)
        topics: dict[int, str] = {}
        try:
            for record in StreamReader(stream, validate_crcs=True, record_size_limit=_RECORD_BYTES).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Record) and record.channel_id in topics:
                    yield Message(topics[record.channel_id], record.log_time, record.sequence, record.data)
        except (McapError, struct.error, EOFError, ValueError, MemoryError, RuntimeError):
            # The end of a file whose writer was cut off: what came before is whole, each chunk has its checksum.
            return
        except Exception as error:
            # Decompressors of damaged chunks raise errors of their own.
            if type(error).__module__.partition(".")[0] not in ("zstandard", "lz4", "zstd", "mcap"):
                raise


class MessageIndex:
    """Messages of a whole recording, by topic and time.

    Parameters
    ----------
    path
        The file; stays open until `close`.

    Raises
    ------
    InputError
        If it has no index, since its writer was cut off.
    """

    def __init__(self, path: Path) -> None:
        need_mcap(str(path))
        from mcap.reader import SeekingReader

        self._path = path
        self._stream = path.open("rb")
        with self._explained():
            self._reader = SeekingReader(self._stream, validate_crcs=True, record_size_limit=_RECORD_BYTES)
            summary = self._reader.get_summary()
            if summary is None or not summary.chunk_indexes:
                raise ValueError("no index")

    def messages(self, topic: str, start_ns: int = 0, end_ns: int | None = None) -> Iterator[Message]:
        """Messages of a topic in the order of their times, from one time to before another."""
        with self._explained():
            found = self._reader.iter_messages([topic], starting_at=start_ns, ending_before=end_ns)
            for _, channel, record in found:
                yield Message(channel.topic, record.log_time, record.sequence, record.data)

    def close(self) -> None:
        """Let the file go."""
        self._stream.close()

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except InputError:
            raise
        # Decompressors of damaged chunks raise errors of their own.
        except Exception as error:
            self._stream.close()
            raise InputError(
                f"{self._path}: cut off or damaged; `tubesight recover {self._path} -o NEW.mcap` writes it anew"
            ) from error


class Recording:
    """A recording: its configuration, and its entries in order.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    InputError
        If it is no recording of this package's, or of another version of the format.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(f"{path}: no such file; name a recording")
        first = next(read_messages(self.path), None)
        if first is None or first.topic != CONFIGURATION_TOPIC:
            raise InputError(f"{path}: not a recording of tubesight's, or cut off before its beginning was written")
        self.configuration = _json(first.data, self.path)
        if self.configuration.get("format") != FORMAT:
            raise InputError(f"{path}: not a {FORMAT} file; read it with the version that wrote it")

    def entries(self) -> Iterator[Entry]:
        """Pictures, results and changes as they were written: the pictures of a pair before its result."""
        messages = read_messages(self.path)
        next(messages, None)
        for message in messages:
            if message.topic.startswith(PICTURE_TOPIC):
                try:
                    form, data = decoded_image(message.data)
                except (struct.error, ValueError):
                    raise InputError(f"{self.path}: a picture in it is damaged; run `tubesight recover`") from None
                camera = message.topic.removeprefix(PICTURE_TOPIC)
                yield RecordedPicture(camera, message.number, message.time_ns, form, data)
            elif message.topic == RESULT_TOPIC:
                yield RecordedResult(message.time_ns, _json(message.data, self.path))
            elif message.topic == CONFIGURATION_TOPIC:
                yield RecordedSwitch(message.time_ns, _json(message.data, self.path))


def _json(data: bytes, path: Path) -> dict[str, Any]:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: damaged, a message is not JSON; run `tubesight recover`") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: damaged, a message is not what the format says; run `tubesight recover`")
    return value
