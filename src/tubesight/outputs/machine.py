"""What made a result."""

from __future__ import annotations

import ctypes
import math
import os
import platform
import sys
from functools import cache
from pathlib import Path

import cv2
import numpy
import scipy


def machine() -> dict[str, str | int]:
    """Describe the machine and the versions that influence numbers and times."""
    return {
        "platform": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "scipy": scipy.__version__,
        "opencv": cv2.__version__,
    }


def resident_mb() -> float:
    """Resident memory of this process, megabytes; where that is not told the largest so far, or NaN."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, AttributeError):
        pass
    try:
        import resource
    except ImportError:  # Windows
        return math.nan
    # Kilobytes, but bytes on macOS.
    unit = 1e6 if platform.system() == "Darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def give_back_memory() -> None:
    """Hand free memory back to the system, where the C library can (glibc).

    Pictures of megabytes that come and go on several threads leave holes in the C library's heap, and a busy moment,
    with more pictures waiting than before, makes it grow for good.
    """
    trim = getattr(_c_library(), "malloc_trim", None)
    if trim is not None:
        trim(0)


@cache
def _c_library() -> ctypes.CDLL | None:
    return ctypes.CDLL(None) if sys.platform == "linux" else None
