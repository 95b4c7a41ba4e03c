"""Data that lies beside the repository and is not part of it; tests that need it skip where it is absent."""

from pathlib import Path

import pytest

_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def shared(name: str) -> Path:
    """Folder ``../shared/data/<name>``, or skip the test."""
    folder = _SHARED / name
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    return folder
