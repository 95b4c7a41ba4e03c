"""From a pair of pictures to the shape of the tube."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from tubesight.core import Array, FramePair, Image, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D, NodeCurve
from tubesight.geometry.rig import Rig
from tubesight.geometry.shape import Shape, shape_of
from tubesight.methods import METHODS
from tubesight.methods.agreement import reprojection_rms_px
from tubesight.methods.choice import PLANE
from tubesight.methods.common_end import to_common_end
from tubesight.methods.mark import from_mark, marked_width_px
from tubesight.methods.rays import optics
from tubesight.methods.whole import believe, see_any, signals_of, solve_any
from tubesight.vision.mark import starts_at
from tubesight.vision.see import Start, clamp_start
from tubesight.vision.signal import Signal
from tubesight.vision.view import View

DEFAULT_METHOD = "silhouette"
# Standard deviation of a triangulated tip across the tube's axis on a photograph, px: with three of it the azimuth of a
# straight tube is noise.
_TIP_SD_PX = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """What one pair of pictures gave; falsy where the status is not ``ok``.

    Attributes
    ----------
    frame
        Name of the pair.
    status, notes
        Outcome, with cautions or the reason of a failure in words.
    shape, curve
        None where the status is not ``ok``.
    views
        By camera name, those that were found.
    method
        Name of the pipeline.
    fit_rms_px
        Distance of the reprojected curve from the views' centrelines.
    ms
        Milliseconds by stage.
    """

    frame: str
    status: Status
    notes: tuple[str, ...]
    shape: Shape | None
    curve: Curve3D | None
    views: Mapping[str, View]
    method: str
    fit_rms_px: float = float("nan")
    ms: Mapping[str, float] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return self.status is Status.OK

    @property
    def total_ms(self) -> float:
        """Milliseconds from pictures to shape."""
        return float(sum(self.ms.values()))


@dataclass(frozen=True)
class ShapeSensor:
    """Measures the shape of one tube with one rig.

    Attributes
    ----------
    rig, tube
        The calibrated cameras and what is known of the tube.
    method
        A name of `tubesight.methods.METHODS`.
    backgrounds
        By camera name, where there are any: the scene without the tube.
    base_px
        By camera name, where the base is marked by hand: its pixel (2,). Marked in two cameras or more it takes the
        place of the clamp; in one it only tells the two ends of the tube apart.
    patient
        Whether a clamped tube that no walk along it measures is looked at once more, as a whole, which takes up to a
        second.

    Examples
    --------
    >>> reconstruction = ShapeSensor(rig, tube)(pair)  # doctest: +SKIP
    """

    rig: Rig
    tube: Tube
    method: str = DEFAULT_METHOD
    backgrounds: Mapping[str, Image] = field(default_factory=dict)
    base_px: Mapping[str, Array] = field(default_factory=dict)
    patient: bool = True

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {self.method!r}")
        if len(self.base_px) > 1:
            object.__setattr__(self, "tube", replace(self.tube, clamped=False))

    def __call__(self, pair: FramePair, family: str = "") -> Reconstruction:
        """Photographs -> views -> curve -> shape; a failure on the way becomes the status.

        Parameters
        ----------
        family
            Family of the tube's curve a moment ago (`Curve3D.model`), where that is known: it is kept where the
            pictures leave the choice open.
        """
        views: dict[str, View] = {}
        ms: dict[str, float] = {}
        try:
            for name, image in pair.images.items():
                with _stage(ms, f"see {name}", name):
                    views[name] = self._see(name, image)
            with _stage(ms, "solve"):
                views = from_mark(views, self.rig, self.base_px)
                if self.tube.tip.shape == "open":
                    views = to_common_end(views, self.rig)
                curve = self._solve(views, family)
                self._believe(pair, views, curve)
                rms, shape = self._shape(views, curve)
        except Unmeasurable as failure:
            try:
                with _stage(ms, "look again"):
                    whole, curve = self._look_again(pair, family)
                    views = dict(whole)
                    rms, shape = self._shape(views, curve)
            except Unmeasurable:
                return Reconstruction(pair.name, failure.status, (str(failure),), None, None, views, self.method, ms=ms)
        notes = [f"{v.camera}: {note}" for v in views.values() for note in v.notes]
        if isinstance(curve, NodeCurve) and curve.note:
            notes.append(curve.note)
        if np.isnan(shape.orientation_rad):
            notes.append("orientation undefined: the tip lies on the base axis")
        return Reconstruction(pair.name, Status.OK, tuple(notes), shape, curve, views, self.method, rms, ms)

    def _solve(self, views: Mapping[str, View], family: str) -> Curve3D:
        method = METHODS[self.method]
        if family and method.solve_again is not None:
            return method.solve_again(views, self.rig, self.tube, family)
        return method.solve(views, self.rig, self.tube)

    def _shape(self, views: Mapping[str, View], curve: Curve3D) -> tuple[float, Shape]:
        """Distance of a curve from the views' centrelines, and its numbers."""
        rms = reprojection_rms_px(curve, views, self.rig)
        return rms, shape_of(curve, 3 * self._tip_sd_mm(curve))

    def _look_again(self, pair: FramePair, family: str) -> tuple[Mapping[str, View], Curve3D]:
        """See the whole silhouette of a clamped tube, of which the walk along it leads to no curve.

        Raises
        ------
        Unmeasurable
            If that does not lead to one either, or method or patience do without it.
        """
        starts = self._starts(pair) if self.patient else {}
        if not starts:
            raise Unmeasurable(Status.TUBE_NOT_FOUND)
        signals = signals_of(pair.images, self.backgrounds, starts)

        def solve(views: Mapping[str, View]) -> Curve3D:
            curve = self._solve(views, family)
            believe(curve, views, self.rig, lambda name: signals[name][0])
            return curve

        return solve_any(see_any(signals, self.rig, self.tube, starts), self.rig, solve)

    def _starts(self, pair: FramePair) -> dict[str, Start]:
        """Where the tube starts in all pictures; none where it is not known, or the method does without whole views."""
        if not METHODS[self.method].whole or self.tube.tip.shape == "open":
            return {}
        starts = {name: self.start_of(name)[0] for name in pair.images}
        return {name: start for name, start in starts.items() if start} if all(starts.values()) else {}

    def _believe(self, pair: FramePair, views: Mapping[str, View], curve: Curve3D) -> None:
        """Refuse a curve of many bends that leaves out a part of the tube; others have no loop to be left out."""
        if curve.model not in PLANE and (starts := self._starts(pair)):

            def signal(name: str) -> Signal:
                return signals_of({name: pair.images[name]}, self.backgrounds, starts)[name][0]

            believe(curve, views, self.rig, signal)

    def _see(self, name: str, image: Image) -> View:
        camera = self.rig.cameras[name]
        width, height = camera.size_px
        if image.shape[:2] != (height, width):
            raise Unmeasurable(
                Status.BAD_IMAGE, detail=f"{image.shape[1]} x {image.shape[0]}, the rig has {width} x {height}"
            )
        start, base_px = self.start_of(name)
        see = partial(METHODS[self.method].see, name, image, self.backgrounds.get(name), camera, self.tube)
        width_px = marked_width_px(name, self.rig, self.tube, self.base_px)
        seen = []
        if base_px is not None and width_px is not None:
            for marked in starts_at(image, base_px, width_px):
                with suppress(Unmeasurable):
                    seen.append(see(marked, base_px))
        if not seen or self.tube.tip.shape == "open":
            # Where no tip has to be found, a walk that is soon lost passes for one: that from the middle counts too.
            seen.append(see(start, base_px))
        # Of the two ways from a mark in the middle the longer one leads to the tip.
        return max(seen, key=lambda view: len(view.edges_px))

    def start_of(self, name: str) -> tuple[Start | None, Array | None]:
        """Where the tube starts in a camera's pictures: the projected clamp, or a pixel of the base, or neither.

        Raises
        ------
        Unmeasurable
            If the clamp is not in the picture.
        """
        camera, pose, base_px = self.rig.cameras[name], self.rig.camera_from_base[name], self.base_px.get(name)
        if self.tube.clamped and self.tube.diameter_mm is not None:
            return clamp_start(camera, pose, self.tube.diameter_mm), base_px
        if self.rig.registered and base_px is None:
            base_px = camera.project(pose.translation_mm)
        return None, base_px

    def _tip_sd_mm(self, curve: Curve3D) -> float:
        tip = curve.points_mm[-1] if isinstance(curve, NodeCurve) else curve.at(np.array([curve.length_mm]))[0]
        sight = optics(self.rig, tuple(self.rig.camera_from_base))
        depth = sight.rotation[:, 2] @ tip + sight.translation_mm[:, 2]
        return _TIP_SD_PX * float((depth / sight.focal_px).max())


@contextmanager
def _stage(ms: dict[str, float], stage: str, camera: str = "") -> Iterator[None]:
    """Time a stage, and name the camera in its failure."""
    start = time.perf_counter()
    try:
        yield
    except Unmeasurable as failure:
        raise Unmeasurable(failure.status, failure.camera or camera, failure.detail) from None
    finally:
        ms[stage] = 1e3 * (time.perf_counter() - start)
