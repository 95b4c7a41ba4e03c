"""``tubesight doctor``: what is wrong with this installation and this machine, and how to mend it."""

from __future__ import annotations

import os
import platform
import re
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

import cv2

from tubesight import __version__
from tubesight.core.kernels import COMPILED
from tubesight.sources.devices import list_devices, supported

Grade = Literal["ok", "warn", "bad"]

_WHEEL = "opencv-contrib-python-headless"
# All of them install the same folder `cv2` over each other.
_WHEELS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", _WHEEL)
# The project's own lower bound on Python.
_PYTHON = (3, 11)
# A port that programs in browsers usually serve from; free ones are found from there on.
_PORT = 8080
# A session of 1000 pairs of 1080p pictures takes about a gigabyte; under 0.1 results and caches fail.
_LITTLE_GB, _TOO_LITTLE_GB = 1.0, 0.1


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked at.

    Attributes
    ----------
    name
        What.
    grade
        ``ok``; ``warn`` where something works less well or is absent; ``bad`` where the tool gives errors.
    found
        What was found.
    remedy
        What to do; empty where nothing has to be done.
    """

    name: str
    grade: Grade
    found: str
    remedy: str = ""


def examine(folder: Path = Path()) -> tuple[Check, ...]:
    """Look at everything.

    Parameters
    ----------
    folder
        Where results will go: its disk is looked at.
    """
    checks = [check_python(), Check("tubesight", "ok", __version__)]
    declared = metadata.requires("tubesight") or []
    checks += check_requirements(declared)
    checks += [check_opencv(_installed_wheels(), declared), check_cache(), *check_cameras(), check_port(_PORT)]
    checks += [check_disk("results", folder), check_disk("temporary files", Path(tempfile.gettempdir()))]
    return tuple(checks)


def check_python() -> Check:
    """Tell whether Python is new enough."""
    found = f"{platform.python_version()} at {sys.executable} on {platform.platform()}"
    if sys.version_info[:2] < _PYTHON:
        return Check("python", "bad", found, "install Python 3.11 or newer, then `make install`")
    return Check("python", "ok", found)


def _declared(requirements: list[str]) -> dict[str, tuple[str, str]]:
    """Bounds and extra by name, from ``name<3,>=2; extra == "plots"``; the extra `all` only repeats others."""
    found: dict[str, tuple[str, str]] = {}
    for requirement in requirements:
        bounds, _, marker = requirement.partition(";")
        match = re.match(r"\s*([A-Za-z0-9._-]+)\s*(?:\[[^\]]*\])?(.*)", bounds)
        extra = re.search(r"extra == ['\"]([^'\"]+)['\"]", marker)
        if match is None or match[1].lower() == "tubesight":
            continue
        if match[1] not in found or found[match[1]][1] == "all":
            found[match[1]] = (match[2].strip(" ()"), extra[1] if extra else "")
    return found


def check_requirements(requirements: list[str]) -> Iterator[Check]:
    """Compare what is installed with what the package declares; OpenCV has a check of its own."""
    for name, (wanted, extra) in _declared(requirements).items():
        if name in _WHEELS:
            continue
        try:
            found = metadata.version(name)
        except metadata.PackageNotFoundError:
            if extra:
                yield Check(name, "warn", "not installed; optional", f"pip install 'tubesight[{extra}]'")
            else:
                yield Check(name, "bad", "not installed", f"pip install '{name}{wanted}'")
            continue
        if _within(found, wanted):
            yield Check(name, "ok", found)
        else:
            yield Check(name, "bad", f"{found}, needed {wanted}", f"pip install '{name}{wanted}'")


def _within(version: str, bounds: str) -> bool:
    """Whether a version satisfies ``>=`` and ``<``, the only bounds this project declares."""
    have = _numbers(version)
    for operator, bound in re.findall(r"(>=|<)\s*([0-9.]+)", bounds):
        if (have >= _numbers(bound)) != (operator == ">="):
            return False
    return True


def _numbers(version: str) -> tuple[int, ...]:
    match = re.match(r"\d+(?:\.\d+)*", version)
    numbers = [int(part) for part in match[0].split(".")] if match else []
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def _installed_wheels() -> list[str]:
    found = []
    for wheel in _WHEELS:
        try:
            found.append(f"{wheel} {metadata.version(wheel)}")
        except metadata.PackageNotFoundError:
            continue
    return found


def check_opencv(wheels: list[str], requirements: list[str]) -> Check:
    """Tell whether there is exactly one OpenCV, of the right version, with ArUco.

    Parameters
    ----------
    wheels
        Installed distributions, as ``name version``.
    requirements
        What the package declares.
    """
    wanted = _declared(requirements).get(_WHEEL, ("", ""))[0]
    mend = f"pip uninstall -y {' '.join(_WHEELS)}; pip install '{_WHEEL}{wanted}'"
    if len(wheels) > 1:
        return Check("opencv wheel", "bad", f"{' and '.join(wheels)} overwrite each other", mend)
    if not _within(cv2.__version__, wanted):
        return Check("opencv wheel", "bad", f"cv2 {cv2.__version__}, needed {wanted}", mend)
    if not hasattr(cv2, "aruco"):
        return Check("opencv wheel", "bad", f"cv2 {cv2.__version__} has no ArUco markers", mend)
    if not wheels:
        return Check("opencv wheel", "warn", f"cv2 {cv2.__version__} comes from no known wheel", mend)
    return Check("opencv wheel", "ok", f"{wheels[0]}, the only one")


def check_cache(compiled: bool = COMPILED) -> Check:
    """Tell whether compiled code can be kept on disk."""
    if not compiled:
        remedy = "set NUMBA_CACHE_DIR to a folder that you can write"
        return Check("compiled code", "warn", "no folder for it can be written: plain NumPy is used, slower", remedy)
    return Check("compiled code", "ok", "kept on disk from run to run")


def check_cameras(root: Path = Path("/")) -> Iterator[Check]:
    """List the cameras, and say which of them cannot be opened."""
    devices = list_devices(root)
    if not devices:
        why = "none" if supported() else "not listed on this system"
        yield Check("cameras", "ok", f"{why}; folders of pictures need none")
    for device in devices:
        found = f"{device.node} {device.name}"
        if device.readable:
            yield Check("camera", "ok", found)
        else:
            remedy = "sudo usermod -aG video $USER, then log in again"
            yield Check("camera", "bad", f"{found} cannot be opened by this user", remedy)


def check_port(port: int) -> Check:
    """Tell whether a port of this machine alone can be listened on."""
    name = f"port {port}"
    try:
        with socket.create_server(("127.0.0.1", port)):
            return Check(name, "ok", "free")
    except OSError as error:
        remedy = "end the program that uses it, or choose another port"
        return Check(name, "warn", f"cannot be used ({error.strerror or error})", remedy)


def check_disk(what: str, folder: Path) -> Check:
    """Tell whether a folder can be written and its disk has room."""
    name = f"disk for {what}"
    try:
        free_gb = shutil.disk_usage(folder).free / 1e9
    except OSError as error:
        return Check(name, "bad", f"{folder.absolute()}: {error.strerror}", "go to a folder that is there")
    found = f"{free_gb:.1f} GB free in {folder.absolute()}"
    if not os.access(folder, os.W_OK):
        return Check(
            name, "warn", f"{folder.absolute()} cannot be written", "go to another folder, or name one with -o"
        )
    if free_gb < _LITTLE_GB:
        return Check(name, "bad" if free_gb < _TOO_LITTLE_GB else "warn", found, "remove files or use another disk")
    return Check(name, "ok", found)
