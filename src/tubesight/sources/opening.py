"""What a line of text means as a camera."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points

from tubesight.core import InputError
from tubesight.sources.fault import fault_source
from tubesight.sources.reader import Source, Wanted, existing
from tubesight.sources.simulated import sim_source
from tubesight.sources.stills import folder_source
from tubesight.sources.stream import http_source
from tubesight.sources.usb import is_device, usb_source
from tubesight.sources.video import SUFFIXES, rtsp_source, video_source

#: Group of entry points by which other packages add cameras: the name is the prefix, ``acme`` for ``acme:SERIAL``, the
#: object a function ``(text, wanted) -> Source``.
ENTRY_POINTS = "tubesight.sources"


def open_source(text: str, wanted: Wanted) -> Source:
    """Find what gives the pictures of a camera; nothing is opened yet.

    Parameters
    ----------
    text
        An index, ``/dev/video0`` or ``usb:NAME`` (with settings as ``?fps=60&exposure=100``), ``http://``,
        ``rtsp://``, a video, a folder of pictures, a recording, ``sim:``, ``fault:SCRIPT:SOURCE``, or the prefix
        of another package's cameras.

    Raises
    ------
    InputError
        If it means nothing, or is not there.
    """
    prefix = text.partition(":")[0]
    for known, make in (
        ("sim", sim_source),
        ("http", http_source),
        ("https", http_source),
        ("rtsp", rtsp_source),
    ):
        if prefix == known and ":" in text:
            return make(text, wanted)
    if prefix == "fault" and ":" in text:
        return fault_source(text, wanted, open_source)
    if is_device(text):
        return usb_source(text, wanted)
    added = _added(prefix) if ":" in text else None
    if added is not None:
        return added(text, wanted)
    path = existing(text)
    if path.is_dir():
        return folder_source(path, wanted)
    if path.suffix.lower() in SUFFIXES:
        return video_source(path, wanted)
    raise InputError(f"{text}: neither a video nor a folder of pictures; see the list of sources in the documentation")


def _added(prefix: str) -> Callable[[str, Wanted], Source] | None:
    """Find the function of another package for a prefix."""
    for point in entry_points(group=ENTRY_POINTS):
        if point.name == prefix:
            try:
                loaded: Callable[[str, Wanted], Source] = point.load()
            except (ImportError, AttributeError) as error:
                raise InputError(
                    f"{prefix}: the package {point.value.partition(':')[0]} that brings these cameras cannot be "
                    f"loaded ({error}); install it again"
                ) from error
            return loaded
    return None
