"""Live sessions that are killed, or whose disk is full, at random moments: what of their recordings is left.

A process of its own gets ready to measure, once, and is then forked for every session: a session starts in a tenth of a
second, and each is a real process with cameras, measurement and recorder. POSIX alone.
"""

from __future__ import annotations

import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import BinaryIO, Literal, get_args

from tubesight.apps.live.loop import Moment
from tubesight.apps.live.options import LiveOptions, RecordOptions, Setup, set_up
from tubesight.apps.live.recover import recover
from tubesight.apps.live.session import run_session
from tubesight.core import InputError
from tubesight.files.recording import RecordedPicture, RecordedResult, Recording
from tubesight.sources.jpeg import decode_picture

Kind = Literal["killed", "disk_full"]
KINDS: tuple[Kind, ...] = get_args(Kind)

# Pictures this small are measured in a few milliseconds, and their recording is of 2 MB a second.
_SIZE, _HZ = (320, 180), 30.0
# A session is killed so long after its first pair: through several of the recorder's intervals of 0.3 s.
_KILL_S = (0.05, 1.5)
# A disk takes so much: from little more than the beginning of a recording to half a second of it. So many pairs have to
# be measured after it was full.
_ROOM_BYTES, _AFTER = (20_000, 1_000_000), 10
# A session that says nothing for so long hangs.
_HANGS_S = 60.0
# What a crash may lose.
MOST_LOST_S = 1.0


@dataclass(frozen=True, slots=True)
class FaultTrial:
    """What was left of the recordings.

    Attributes
    ----------
    kind
        ``killed`` (SIGKILL) or ``disk_full`` (no write beyond a random byte).
    sessions
        How many there were.
    unreadable
        Recordings that the ordinary reader, or ``recover``, does not read, or with a picture that is damaged.
    stopped
        Sessions that did not go on measuring to their end; of those that were not killed.
    worst_lost_s, mean_lost_s
        From the last result that is in the file, or from the first pair where there is none, to the last pair that was
        measured before the session was killed, or before the disk was found full.
    problems
        The first things that went wrong, in words.
    """

    kind: Kind
    sessions: int
    unreadable: int
    stopped: int
    worst_lost_s: float
    mean_lost_s: float
    problems: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """Whether every recording is readable to its last second, and every session went on."""
        return not self.unreadable and not self.stopped and self.worst_lost_s <= MOST_LOST_S

    def line(self) -> str:
        """One line for people."""
        what = "sessions killed" if self.kind == "killed" else "sessions with a full disk"
        went = "" if self.kind == "killed" else f", {self.sessions - self.stopped} went on measuring"
        return (
            f"{self.sessions} {what}{went}: {self.sessions - self.unreadable} recordings readable, at worst the last "
            f"{self.worst_lost_s:.2f} s lost, on average {self.mean_lost_s:.2f} s"
        )


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of one session: seconds lost (NaN for an unreadable recording), whether it went on, and what went wrong."""

    lost_s: float
    went_on: bool
    problem: str = ""


def fault_trial(kind: Kind, sessions: int, seed: int = 0) -> FaultTrial:
    """Run sessions, one after the other, at two a second or slower.

    Raises
    ------
    InputError
        If processes cannot be forked here, or the sessions cannot be run at all.
    """
    if not hasattr(os, "fork"):
        raise InputError("--faults: needs a system that can fork processes (Linux, macOS)")
    script = f"from tubesight.apps.live.fault_trial import nursery; nursery({kind!r}, {sessions}, {seed})"
    # Libraries with threads of their own do not survive a fork.
    alone = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, env={**os.environ, **alone}
    )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise InputError(f"--faults: sessions cannot be run here ({last})")
    return summed(kind, [Outcome(**row) for row in json.loads(done.stdout)])


def summed(kind: Kind, outcomes: Sequence[Outcome]) -> FaultTrial:
    """Sum outcomes up."""
    lost = [outcome.lost_s for outcome in outcomes if math.isfinite(outcome.lost_s)]
    return FaultTrial(
        kind,
        len(outcomes),
        len(outcomes) - len(lost),
        sum(not outcome.went_on for outcome in outcomes),
        max(lost, default=math.nan),
        sum(lost) / len(lost) if lost else math.nan,
        tuple(outcome.problem for outcome in outcomes if outcome.problem)[:5],
    )


def nursery(kind: Kind, sessions: int, seed: int) -> None:
    """Get ready, run the sessions, and print their outcomes as JSON; has to have a process of its own."""
    import cv2

    cv2.setNumThreads(1)
    draw = random.Random(f"{kind}/{seed}")
    outcomes = []
    with tempfile.TemporaryDirectory() as folder:
        sources = dict.fromkeys(("left", "right"), f"sim:{_HZ:g}")
        first = LiveOptions(sources, size_px=_SIZE, gray=True, seconds=0.2)
        setup = set_up(first)
        run_session(first, setup)
        for k in range(sessions):
            path = Path(folder) / f"{k}.mcap"
            options = replace(first, seconds=_HANGS_S / 2, record=RecordOptions(path))
            one = _killed if kind == "killed" else _disk_full
            outcomes.append(asdict(one(options, setup, path, draw)))
            path.unlink(missing_ok=True)
    sys.stdout.write(json.dumps(outcomes))


def _killed(options: LiveOptions, setup: Setup, path: Path, draw: random.Random) -> Outcome:
    pid, said = _forked(options, setup, None)
    with said:
        first = said.readline()
        time.sleep(draw.uniform(*_KILL_S))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        heard = _numbers([first, *said])
    if isinstance(heard, str):
        return Outcome(math.nan, went_on=True, problem=heard)
    return _outcome(path, heard[0], heard[-1], went_on=True)


def _disk_full(options: LiveOptions, setup: Setup, path: Path, draw: random.Random) -> Outcome:
    pid, said = _forked(options, setup, draw.randint(*_ROOM_BYTES))
    with said:
        heard = _numbers(list(said))
        os.waitpid(pid, 0)
    if isinstance(heard, str):
        return Outcome(math.nan, went_on=False, problem=heard)
    # The pairs after the one with which the disk was found full are the last.
    full = max(len(heard) - 1 - _AFTER, 0)
    return _outcome(path, heard[0], heard[full], went_on=full > 0)


def _numbers(lines: list[bytes]) -> list[float] | str:
    """Read what a session said: times, or why there are none."""
    if not any(lines):
        return "the session ended without a word"
    try:
        return [float(line) for line in lines]
    except ValueError:
        return lines[-1].decode("utf-8", "replace").strip()


def _forked(options: LiveOptions, setup: Setup, room_bytes: int | None) -> tuple[int, BinaryIO]:
    """Start a session in a process of its own; its number, and what it will say: the time of each pair, a line each."""
    read, write = os.pipe()
    pid = os.fork()
    if pid:
        os.close(write)
        return pid, os.fdopen(read, "rb")
    try:
        signal.alarm(int(_HANGS_S))
        _session(options, setup, room_bytes, write)
    except BaseException as failure:
        os.write(write, f"{type(failure).__name__}: {failure}\n".encode())
    finally:
        os._exit(0)


def _session(options: LiveOptions, setup: Setup, room_bytes: int | None, said: int) -> None:
    if room_bytes is not None:
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, room_bytes))
    after = 0

    def tell(moment: Moment) -> None:
        nonlocal after
        os.write(said, b"%r\n" % moment.tracked.time_s)
        if after or (room_bytes is not None and "stopped" in moment.figures().recorded):
            after += 1
        if after > _AFTER:
            # Ends the session as Ctrl-C does.
            raise KeyboardInterrupt

    run_session(options, setup, tell)
    if room_bytes is not None and not after:
        raise RuntimeError("the disk was never found full")


def _outcome(path: Path, begun_s: float, end_s: float, went_on: bool) -> Outcome:
    """Read what is left, by the ordinary reader and after ``recover``."""
    try:
        last_s, results = _last(path)
        whole = path.with_suffix(".whole.mcap")
        recover(path, whole)
        again = _last(whole)
        whole.unlink()
    except InputError as error:
        return Outcome(math.nan, went_on, str(error))
    if again[1] != results:
        return Outcome(math.nan, went_on, f"{results} results, but {again[1]} after it was recovered")
    problem = "" if went_on else "did not go on measuring"
    return Outcome(end_s - (last_s if results else begun_s), went_on, problem)


def _last(path: Path) -> tuple[float, int]:
    """When the last result was, and how many there are; every picture is decoded."""
    last_s, results = math.nan, 0
    for entry in Recording(path).entries():
        if isinstance(entry, RecordedResult):
            last_s, results = float(entry.data["time_s"]), results + 1
        elif isinstance(entry, RecordedPicture):
            decode_picture(entry.data, path.name, gray=True)
    return last_s, results
