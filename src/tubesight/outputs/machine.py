"""What made a result."""

from __future__ import annotations

import math
import os
import platform
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
