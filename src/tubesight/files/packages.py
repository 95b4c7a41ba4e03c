"""Optional packages: what to install where one is missing."""

from __future__ import annotations

from importlib.util import find_spec

from tubesight.core import InputError


def require_package(package: str, extra: str, need: str) -> None:
    """Raise `InputError` where an optional package is missing.

    Parameters
    ----------
    package, extra
        What is imported, and the extra of tubesight that installs it.
    need
        Who needs it: how the text begins.
    """
    if find_spec(package) is None:
        raise InputError(f"{need}; pip install 'tubesight[{extra}]'")
