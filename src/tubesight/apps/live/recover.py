"""``tubesight recover``: a recording whose writer was cut off, written anew with its index."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tubesight.core import InputError
from tubesight.files.recording import RESULT_TOPIC, Recording, read_messages
from tubesight.outputs.mcap_file import McapFile


@dataclass(frozen=True, slots=True)
class Recovered:
    """What was found: messages in all, results, and the seconds they span."""

    messages: int
    results: int
    seconds: float


def recover(path: Path, out: Path) -> Recovered:
    """Copy every whole message of a recording to a new file.

    Raises
    ------
    InputError
        If the file is no recording, or the new one cannot be written.
    """
    Recording(path)
    if out.resolve() == path.resolve():
        raise InputError(f"{out}: is the recording itself; name a new file with -o")
    count = results = 0
    times: list[int] = []
    try:
        with McapFile(out) as file:
            for message in read_messages(path):
                file.write(message.topic, message.time_ns, message.number, message.data)
                count += 1
                if message.topic == RESULT_TOPIC:
                    results += 1
                    times = [*times[:1], message.time_ns]
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another place") from error
    return Recovered(count, results, (times[-1] - times[0]) / 1e9 if times else 0.0)
