"""Compiling hot functions with numba, where that is possible; each has a readable NumPy twin that can replace it."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_CONFIG: Any = numba.config
_PACKAGE = Path(__file__).resolve().parents[1]
# What compiled code depends on: numba looks at a function's own file only, not at what it calls or at constants from
# elsewhere, so that each state of these files gets a folder of its own.
_SOURCES = (
    "*/*kernels.py",
    "methods/solve.py",
    "methods/rays.py",
    "geometry/families.py",
    "geometry/rig.py",
    "geometry/lens.py",
    "vision/*.py",
)

# Newest release of numba whose inner parts are as `part_kernels` takes them; 0.60, 0.63 and 0.68 were tried. With a
# newer one parts are compiled as all other functions are, which only takes longer.
_TRIED = (0, 68)

# Folders of other states of the sources are removed when no process started with them for so long (that touches them).
_KEPT_S = 30 * 86400.0


def _stamp() -> str:
    """Name of the state of the sources."""
    digest = hashlib.sha256(numba.__version__.encode())
    for pattern in _SOURCES:
        for path in sorted(_PACKAGE.glob(pattern)):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _folder() -> Path | None:
    """Folder for compiled code: where numba is told to, beside the package, in the user's cache, or a temporary one."""
    told = os.environ.get("NUMBA_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    temporary = Path(tempfile.gettempdir()) / f"tubesight-{os.getuid() if hasattr(os, 'getuid') else 'cache'}"
    for root in (Path(told) if told else None, _PACKAGE / "__pycache__", user / "tubesight", temporary):
        if root is None:
            continue
        folder = root / f"kernels-{_stamp()}"
        try:
            if not folder.is_dir():
                folder.mkdir(parents=True, exist_ok=True, mode=0o700)
                _remove_old(root)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return None


def _remove_old(root: Path) -> None:
    """Remove folders of compiled code that have not been used for long."""
    for other in root.glob("kernels-*"):
        if other.stat().st_mtime < time.time() - _KEPT_S:
            shutil.rmtree(other, ignore_errors=True)


#: Folder of compiled code; None where none can be written.
FOLDER = _folder()

#: Whether functions are compiled. Without a folder to keep them in, that would cost seconds in every process: the NumPy
#: twins are used then.
COMPILED = FOLDER is not None and not _CONFIG.DISABLE_JIT


def compiled(function: F) -> F:
    """Compile a function (kept on disk, without the interpreter's lock); where that is impossible leave it as it is."""
    if not COMPILED:
        return function
    before = _CONFIG.CACHE_DIR
    _CONFIG.CACHE_DIR = str(FOLDER)
    try:
        return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
    finally:
        _CONFIG.CACHE_DIR = before


def part(function: F) -> F:
    """Compile a function that only compiled ones call: without an entry from Python, which takes long to compile."""
    return _part(function, "never")


def short_part(function: F) -> F:
    """Compile a short `part` as if it stood where it is called."""
    return _part(function, "always")


def _part(function: F, inline: str) -> F:
    if not COMPILED:
        return function
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "inline": inline}
    if numba.version_info.short <= _TRIED:
        from tubesight.core.part_kernels import PartCompiler

        options["pipeline_class"] = PartCompiler
    return cast(F, numba.njit(nogil=True, error_model="numpy", **options)(function))
