"""What made a result."""

from __future__ import annotations

import os
import platform

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
