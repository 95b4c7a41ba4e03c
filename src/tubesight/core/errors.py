"""What goes wrong, in the user's words."""

from __future__ import annotations


class InputError(ValueError):
    """An input that cannot be used; its text is one line that names the input and the remedy.

    Raised by loaders, importers and calibration; the command line prints it and exits with code 1.
    """
