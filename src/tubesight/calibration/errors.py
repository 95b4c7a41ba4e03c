"""What the pictures of a calibration lack."""

from __future__ import annotations

from tubesight.core import InputError


class CalibrationError(InputError):
    """Pictures or points that cannot give a calibration; one line that says why, without the folder's name."""
