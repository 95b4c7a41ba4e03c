"""Tasks done once: what was done before an interruption is not done again."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import tubesight
from tubesight.apps.pool import Pool
from tubesight.core import InputError
from tubesight.files.nested import plain
from tubesight.files.safe import write_atomic

Task = TypeVar("Task")
Result = TypeVar("Result")
# Hexadecimal digits of a task's name: 128 bits are equal for no two tasks.
_DIGITS = 32
_NAME = re.compile(rf"[0-9a-f]{{{_DIGITS}}}")
Progress = Callable[[str, int, int], None]
"""Called with what the tasks are of, how many are done and how many there are."""


class Remembered:
    """A pool that keeps the result of each task in a file and does no task twice.

    Parameters
    ----------
    folder
        Holds one JSON file a task, named by function, task and source of the package: other code, other results.
        Batches that have a task in common share it.
    pool
        Does what is not there yet.
    progress
        Called before the first task and after each.
    holds
        Whether a result that was kept is still good, where it speaks of more than itself, such as of files; one that
        is not is made again.
    """

    def __init__(
        self,
        folder: Path,
        pool: Pool,
        progress: Progress = lambda batch, done, total: None,
        holds: Callable[[Any], bool] = lambda result: True,
    ) -> None:
        self._folder = folder
        self._pool = pool
        self._progress = progress
        self._holds = holds

    def __call__(self, batch: str, function: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
        """Return results in the order of the tasks, as JSON gives them back.

        Parameters
        ----------
        batch
            What the tasks are of, for `progress`.
        function
            Of a module's top level: it is sent to other processes. Equal tasks have to give equal results.
        tasks
            Frozen dataclasses of plain data and paths.
        """
        paths = [self._folder / f"{_key(function, task)}.json" for task in tasks]
        results = {}
        for i, path in enumerate(paths):
            try:
                result = json.loads(path.read_bytes())
            except (OSError, ValueError):
                # Not there yet, or damaged.
                continue
            if self._holds(result):
                results[i] = result
        self._progress(batch, len(results), len(tasks))
        missing = [i for i in range(len(tasks)) if i not in results]
        for done, result in self._pool(function, [tasks[i] for i in missing]):
            # Fresh results go through JSON as kept ones do, so that both are equal.
            text = json.dumps(plain(result))
            write_atomic(paths[missing[done]], text)
            results[missing[done]] = json.loads(text)
            self._progress(batch, len(results), len(tasks))
        return [cast(Result, results[i]) for i in range(len(tasks))]


def forget(folder: Path) -> None:
    """Remove what a `Remembered` kept in a folder, and nothing else: the folder may be of somebody else's making."""
    try:
        for path in folder.glob("*.json"):
            if _NAME.fullmatch(path.stem):
                path.unlink()
    except OSError as error:
        raise InputError(f"{folder}: cannot be emptied ({error.strerror}); name another folder with -o") from error


def _key(function: Callable[..., object], task: Any) -> str:
    """Name of a task's file."""
    parts = (_source(), function.__module__, function.__qualname__, json.dumps(plain(asdict(task)), sort_keys=True))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:_DIGITS]


@cache
def _source() -> str:
    """Hash of the package's source."""
    root = Path(tubesight.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
