"""Parts: functions that only compiled ones call, which are linked but not brought to machine code by themselves."""

import os
import subprocess
import sys
from typing import Any

import pytest

from tubesight.core.kernels import COMPILED

pytestmark = pytest.mark.skipif(not COMPILED, reason="nothing is compiled here")

#: A module with an entry that calls a part, which calls another: twice the sum of the squares.
MODULE = """
import numba
numba.version_info = numba.version_info._replace(short={short})
from tubesight.core.kernels import compiled, part

@part
def square(x):
    return x * x

@part
def squares(values):
    total = 0.0
    for x in values:
        total += square(x)
    return total

@compiled
def doubled(values):
    return 2.0 * squares(values)
"""
SUM = "import numpy as np; import told; print(told.doubled(np.arange(4.0)))"
LIBRARY = "; [one] = told.squares.overloads.values(); print(type(one.library).__name__)"
CALL = "; told.squares(np.arange(4.0))"


def run(folder: Any, code: str, short: str = "numba.version_info.short") -> Any:
    """Run code that imports the module as `told`, in a process and with a cache of its own."""
    (folder / "told.py").write_text(MODULE.format(short=short))
    paths = os.pathsep.join([str(folder), *sys.path])
    env = os.environ | {"PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(folder / "cache")}
    return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=120)


def test_part_has_no_machine_code_of_its_own(tmp_path: Any) -> None:
    """The entry gives the same when it is compiled and when a second process finds it in the cache."""
    first = run(tmp_path, SUM + LIBRARY)
    assert first.stdout.split() == ["28.0", "PartLibrary"], first.stderr
    assert list((tmp_path / "cache").rglob("*.nbc"))
    assert run(tmp_path, SUM).stdout.split() == ["28.0"]


def test_part_called_from_python_is_an_error(tmp_path: Any) -> None:
    done = run(tmp_path, SUM + CALL)
    assert done.returncode == 1 and "TypeError" in done.stderr


def test_with_a_numba_that_was_not_tried_parts_are_ordinary_functions(tmp_path: Any) -> None:
    done = run(tmp_path, SUM + LIBRARY, short="(1, 0)")
    assert done.stdout.split() == ["28.0", "JITCodeLibrary"], done.stderr
