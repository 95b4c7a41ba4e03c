"""Tasks for the tests of what is spread over processes: other processes import them from here by name."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Number:
    """A number, and a folder where every call leaves a file."""

    value: float
    folder: str


def third(task: Number) -> dict[str, float]:
    """Divide by three, which JSON has to give back to the last bit."""
    calls = len(list(Path(task.folder).iterdir()))
    (Path(task.folder) / f"{task.value}-{calls}-{os.getpid()}").touch()
    return {"third": task.value / 3}


def until_four(task: Number) -> dict[str, float]:
    """Fail at the fifth number, as an interruption would."""
    if task.value >= 4:
        raise KeyboardInterrupt
    return third(task)


def fatal(task: Number) -> float:
    """Kill the process that does it, the first time."""
    mark = Path(task.folder) / "killed"
    if task.value == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return task.value**2


def deadly(task: Number) -> None:
    """Kill the process that does it."""
    os.kill(os.getpid(), signal.SIGKILL)


def slow_but_first(task: Number) -> None:
    """Be done, the first one, when the others have begun what takes half a minute."""
    folder = Path(task.folder)
    if task.value == 0:
        while not (folder / "started").exists():
            time.sleep(0.01)
        return
    (folder / "started").touch()
    time.sleep(30.0)
    (folder / "ended").touch()
