"""What the live commands need to know, and what they make of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from tubesight.apps.run import tube_for
from tubesight.core import Array, Image, InputError, Tube
from tubesight.files.rig import RIG_BYTES, refuse_camera_name, rig_from_text, rig_text
from tubesight.files.safe import read_text
from tubesight.geometry.rig import Rig
from tubesight.sensor import DEFAULT_METHOD, ShapeSensor
from tubesight.sources.folder import read_backgrounds
from tubesight.sources.opening import open_source
from tubesight.sources.reader import TIMEOUT_S, Source, Wanted
from tubesight.sources.simulated import SIM_TUBE, sim_rig
from tubesight.tracking.designation import Designation

# Pictures of free-running cameras are taken for one instant up to this difference.
TOLERANCE_S = 0.01
# From the pair's time to its shape: what position control by the measured tip can live with.
DEADLINE_S = 0.05

PictureMode = Literal["lossless", "jpeg", "crop", "none"]


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """What is recorded.

    Attributes
    ----------
    path
        The file, ``.mcap``; must be new.
    pictures
        ``lossless``: as the camera coded them, else PGM; ``jpeg``: quality 95; ``crop``: PGM of the tube and what is
        near it; ``none``.
    every
        Pictures of every n-th pair; results of all.
    """

    path: Path
    pictures: PictureMode = "lossless"
    every: int = 1


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """What ``live`` and ``record`` work with.

    Attributes
    ----------
    sources
        By camera name, see `tubesight.sources.opening.open_source`.
    rig_path, tube_path
        ``rig.yaml``, absent for the simulator's own; ``tube.yaml``.
    method
        Name of a registered method.
    base_px
        Pixel of the tube's base by camera, where it is not to be found from the rig.
    tip_px
        Pixel of the tube's tip by camera, where several devices are in view: the one to follow.
    background_path
        Pictures without the tube.
    size_px
        (width, height) to ask cameras for; None for those of the rig.
    gray
        Whether to do without colour.
    tolerance_s
        Largest difference between the times of a pair's pictures.
    offset_s
        By camera: constant delay of its times.
    deadline_s
        Results later than this after their pictures are flagged.
    seconds
        Stop after so long; None for Ctrl-C.
    filtered
        Whether to filter the shape too.
    record
        What to record; None for nothing.
    timeout_s
        A camera that gives nothing for so long is opened anew.
    """

    sources: Mapping[str, str]
    rig_path: Path | None = None
    tube_path: Path | None = None
    method: str = DEFAULT_METHOD
    base_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    tip_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    background_path: Path | None = None
    size_px: tuple[int, int] | None = None
    gray: bool = False
    tolerance_s: float = TOLERANCE_S
    offset_s: Mapping[str, float] = field(default_factory=dict)
    deadline_s: float = DEADLINE_S
    seconds: float | None = None
    filtered: bool = False
    record: RecordOptions | None = None
    timeout_s: float = TIMEOUT_S


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """Rig, tube and cameras of a session, and what the user should know of them."""

    rig: Rig
    rig_text: str
    tube: Tube
    sources: Mapping[str, Source]
    base_px: Mapping[str, Array]
    tip_px: Mapping[str, Array]
    backgrounds: Mapping[str, Image]
    method: str
    messages: tuple[str, ...]

    def sensor(self) -> ShapeSensor:
        """Return the sensor of this session."""
        return ShapeSensor(self.rig, self.tube, self.method, self.backgrounds, self.base_px, patient=False)

    def designation(self) -> Designation:
        """Return which device this session follows, as far as that is known before it begins."""
        return Designation(self.tip_px, has_end=self.tube.tip.shape != "open")


def set_up(options: LiveOptions) -> Setup:
    """Read the files and find the sources; no camera is opened.

    Raises
    ------
    InputError
        If a file cannot be used, a source means nothing, or they do not fit the rig.
    """
    for name in (*options.sources, *options.base_px, *options.tip_px, *options.offset_s):
        refuse_camera_name(name, "--source")
    messages: list[str] = []
    rig, text = _rig(options, messages)
    known = SIM_TUBE if all(simulated(text) for text in options.sources.values()) else None
    tube = tube_for(options.tube_path, rig, messages, known)
    named = {"source": options.sources, "base": options.base_px, "tip": options.tip_px, "offset": options.offset_s}
    for what, names in named.items():
        unknown = sorted(set(names) - set(rig.names))
        if unknown:
            raise InputError(f"--{what} names camera {unknown[0]!r}, but the rig has {', '.join(rig.names)}")
    lacking = [name for name in rig.names if name not in options.sources]
    if lacking:
        raise InputError(f"camera {lacking[0]!r} of the rig has no source; give --source {lacking[0]}=...")
    sources = {
        name: open_source(
            options.sources[name],
            Wanted(name, options.size_px or rig.cameras[name].size_px, options.gray, options.timeout_s, rig, tube),
        )
        for name in rig.names
    }
    backgrounds = read_backgrounds(options.background_path, rig) if options.background_path is not None else {}
    base, tip = (
        {name: np.array(px, float) for name, px in marks.items()} for marks in (options.base_px, options.tip_px)
    )
    return Setup(rig, text, tube, sources, base, tip, backgrounds, options.method, tuple(messages))


def simulated(text: str) -> bool:
    """Whether a source is the simulator, with or without faults."""
    return text.startswith("sim:") or (text.startswith("fault:") and simulated(text.split(":", 2)[-1]))


def _rig(options: LiveOptions, messages: list[str]) -> tuple[Rig, str]:
    if options.rig_path is None:
        if len(options.sources) < 2 or not all(simulated(text) for text in options.sources.values()):
            raise InputError("a rig file is needed; give --rig, or simulated cameras alone, as --source left=sim:")
        messages.append("no rig file: simulated cameras around a simulated tube")
        # Through its text, so that a recording, which holds the text, is measured again with the very same numbers.
        text = rig_text(sim_rig(options.size_px, tuple(options.sources)))
        return rig_from_text(text, Path("simulated rig")).rig, text
    text = read_text(options.rig_path, RIG_BYTES)
    rig = rig_from_text(text, options.rig_path).rig
    lacking = [name for name in rig.names if name not in rig.camera_from_base]
    if lacking or len(rig.names) < 2:
        what = f"the pose of {', '.join(lacking)} is not known" if lacking else "a 3-D shape needs two cameras"
        raise InputError(f"{options.rig_path}: {what}; run `tubesight calibrate` on pictures of both cameras")
    if rig.covariance is None:
        messages.append("the rig has no covariance: deviations cover the pictures alone, not the calibration")
    return rig, text
