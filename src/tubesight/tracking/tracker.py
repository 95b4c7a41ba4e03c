"""From reconstructions one by one to a track: state, prediction, doubt, and the optional filter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from tubesight.core import Array
from tubesight.geometry.curve import Curve3D, NodeCurve
from tubesight.geometry.shape import SD_NAMES, Shape
from tubesight.sensor import Reconstruction
from tubesight.tracking.designation import Designation, agreed, contradiction, followers, withheld
from tubesight.tracking.kalman import Moving, begin, correct, distance_squared, predict
from tubesight.tracking.pairing import Matched
from tubesight.tracking.states import TRANSITIONS, Event, State
from tubesight.tracking.watch import CameraFault

# A tip that swings by +-30 mm twice a second is accelerated by 30 (4 pi)^2 = 4700 mm/s^2.
ACCELERATION_MM_PER_S2 = 5000.0
# A tube at its first measurement may be moving already: pushed by hand at up to 300 mm/s.
_SPEED_SD_MM_PER_S = 300.0
# Chi squared of three degrees of freedom beyond which a tip contradicts its prediction: once in 100000 by chance.
_GATE = 25.9
# Pictures without a camera's own clock bear the time at which they came: after a stall of network or machine some
# come at once. A tip that contradicts its prediction may have gone on along its way for one frame at 30 Hz.
_BUNCHED_S = 1 / 30
# Doubtful tips in a row that agree with each other are the tube, moved; the track begins anew there. After a loss a
# tube that was well known is believed as late: a device that moves through its place has its length for a moment only.
_CONVINCED = 3
# A loss is longer than this: half a second without a measurement.
_LOST_S = 0.5
# Where the picture's deviations are not known, those of a fair view.
_UNKNOWN_SD_MM = 0.2
# Shares of the length at which the filter follows the curve: base, and quarters up to the tip.
FILTER_SHARES = np.array([0.25, 0.5, 0.75, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """What is published of one moment.

    Attributes
    ----------
    result
        The reconstruction of this pair alone, never filtered; its deviations include what the skew adds. One that is
        doubted has no numbers. None where no pair came (a fault, or silence).
    state
        Of the tracking.
    time_s, skew_s
        Mean time of the pair's pictures on the rig's clock, and largest difference between them.
    faults
        Cameras that give no new pictures.
    notes
        What the tracking has to say.
    pair
        The pictures.
    predicted_tip_mm
        (3,) where the tip was expected; None where nothing was.
    filtered
        `FILTER_SHARES` of the curve as 12 coordinates with covariance, where a filter is asked for.
    latency_s
        From the pair's time to its result; NaN for a replay.
    late
        Whether that was more than the deadline.
    moved
        Which camera seems to have moved, in a sentence; empty while the rig is as it was.
    family
        Family of the curve a moment ago, of which the method was told (`ShapeSensor`).
    """

    result: Reconstruction | None
    state: State
    time_s: float
    skew_s: float = 0.0
    faults: Mapping[str, CameraFault] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    pair: Matched | None = None
    predicted_tip_mm: Array | None = None
    filtered: Moving | None = None
    latency_s: float = math.nan
    late: bool = False
    moved: str = ""
    family: str = ""


class Tracker:
    """Follows one tube; a function of reconstructions and times alone, with no clock of its own.

    Parameters
    ----------
    filtered
        Whether to filter the shape.
    acceleration_mm_per_s2
        Standard deviation of the acceleration that prediction and filter allow for.
    designation
        Which device is to be followed; the first one measured where nothing is said.
    """

    def __init__(
        self,
        filtered: bool = False,
        acceleration_mm_per_s2: float = ACCELERATION_MM_PER_S2,
        designation: Designation | None = None,
    ) -> None:
        self._known = designation or Designation()
        self.state = State.SEARCHING
        self._acceleration, self._filtering = acceleration_mm_per_s2, filtered
        self._tip: Moving | None = None
        self._filter: Moving | None = None
        self._before: tuple[float, Shape] | None = None
        self._doubts: list[tuple[float, Array]] = []
        self._good_s = math.nan
        self._family = ""

    @property
    def family(self) -> str:
        """Family of the curve of the last good pair; empty where the tube is not followed."""
        return self._family if self.state in (State.TRACKING, State.DEGRADED) else ""

    def begin_anew(self) -> None:
        """Take the next tube measured for the one to follow: another method, or a base marked by hand, was chosen."""
        self._known = Designation(has_end=self._known.has_end)
        self._doubts, self._family = [], ""
        self._forget()

    def event(self, event: Event) -> State:
        """Move to the next state."""
        self.state = TRANSITIONS[self.state, event]
        return self.state

    def watch(self, faults: Mapping[str, CameraFault], time_s: float) -> Tracked | None:
        """Take faults of cameras into account; what to publish, where the state changes or a fault lasts."""
        if faults:
            self.event(Event.CAMERA_FAULT)
            return Tracked(None, self.state, time_s, faults=dict(faults), notes=_say(faults))
        if self.state is State.FAULT:
            # A moment's silence, on a machine that is busy, is no reason to doubt the tube afterwards.
            if not time_s - self._good_s <= _LOST_S:
                self._forget()
            self.event(Event.CAMERAS_BACK)
            return Tracked(None, self.state, time_s, notes=("all cameras are back",))
        return None

    def step(self, result: Reconstruction, pair: Matched) -> Tracked:
        """Take the reconstruction of one pair into account."""
        time_s, skew_s = pair.time_s, pair.skew_s
        shape, curve = result.shape, result.curve
        if not result or shape is None or curve is None:
            # `not <=`: before the first good pair the time since it is not known.
            missed = Event.MISSED_LONG if time_s - self._good_s > _LOST_S else Event.MISSED
            self.event(missed)
            if self.state is State.LOST:
                self._forget()
            return Tracked(result, self.state, time_s, skew_s, notes=result.notes, pair=pair)
        shape = self._with_skew(shape, time_s, skew_s)
        result = replace(result, shape=shape)
        sd = np.array([shape.sd[name] for name in ("tip_x", "tip_y", "tip_z")])
        covariance = np.diag(np.where(np.isfinite(sd), sd, _UNKNOWN_SD_MM) ** 2)
        predicted = predict(self._tip, time_s, self._acceleration) if self._tip is not None else None
        if predicted is not None and distance_squared(predicted, shape.tip_mm, covariance) > _GATE:
            way = _BUNCHED_S * predicted.velocity_mm_per_s
            covariance = covariance + np.outer(way, way)
        why = contradiction(self._known, result, shape, curve, time_s)
        if why:
            self._doubts = []
        else:
            why = self._doubt(predicted, shape.tip_mm, covariance, time_s)
        predicted = predicted if self._tip is not None else None
        if why:
            return self._refused(result, pair, why, predicted)
        self._before = (time_s, shape)
        self._good_s, self._family = time_s, curve.model
        self._known = agreed(self._known, result, shape, curve, time_s)
        self._tip = _corrected(predicted, time_s, shape.tip_mm, covariance)
        if self._filtering:
            self._filter = self._filtered(curve, time_s)
        self.event(Event.GOOD)
        expected = predicted.position_mm if predicted is not None else None
        return Tracked(result, self.state, time_s, skew_s, {}, (), pair, expected, self._filter)

    def _refused(self, result: Reconstruction, pair: Matched, why: str, predicted: Moving | None) -> Tracked:
        """Publish a pair without its numbers: what was measured may be another device."""
        where = followers(self._known, result.views)
        why += f"; {where} may follow something else" if where else ""
        self.event(Event.DOUBTFUL if not pair.time_s - self._good_s > _LOST_S else Event.MISSED_LONG)
        if self.state is State.LOST:
            self._forget()
        expected = predicted.position_mm if predicted is not None else None
        told = withheld(result, why)
        return Tracked(told, self.state, pair.time_s, pair.skew_s, {}, told.notes, pair, expected)

    def _doubt(self, predicted: Moving | None, tip_mm: Array, covariance: Array, time_s: float) -> str:
        """Say why this tip cannot follow those before; nothing where it can, or where enough agree on it."""
        if predicted is None:
            expected = not self._known.settled
        else:
            expected = distance_squared(predicted, tip_mm, covariance) <= _GATE
        if expected:
            self._doubts = []
            return ""
        self._doubts = [*self._doubts, (time_s, tip_mm)][-_CONVINCED:]
        spread = float(np.ptp(np.array([tip for _, tip in self._doubts]), axis=0).max())
        if predicted is None:
            limit = _SPEED_SD_MM_PER_S * min(time_s - self._doubts[0][0], _LOST_S)
            why = f"the tube was lost: it is believed after {_CONVINCED} pairs that agree"
        else:
            limit = float(np.linalg.norm(tip_mm - predicted.position_mm))
            why = f"the tip is {limit:.1f} mm from where it was expected: moved very fast, or it is another thing"
        if len(self._doubts) == _CONVINCED and spread < limit:
            self._forget()
            self._doubts = []
            return ""
        return why

    def _forget(self) -> None:
        self._tip = self._filter = self._before = None

    def _filtered(self, curve: Curve3D, time_s: float) -> Moving:
        points = curve.at(FILTER_SHARES * curve.length_mm)
        off = [np.zeros_like(points)]
        if isinstance(curve, NodeCurve) and curve.from_picture:
            off = [other.at(FILTER_SHARES * other.length_mm) - points for other in curve.from_picture]
        rows = np.array(off).reshape(len(off), -1)
        # One micrometre keeps the sum of a few displaced curves invertible.
        covariance = rows.T @ rows + 1e-6 * np.eye(rows.shape[1])
        if not rows.any():
            covariance = _UNKNOWN_SD_MM**2 * np.eye(rows.shape[1])
        predicted = predict(self._filter, time_s, self._acceleration) if self._filter is not None else None
        return _corrected(predicted, time_s, points.ravel(), covariance)

    def _with_skew(self, shape: Shape, time_s: float, skew_s: float) -> Shape:
        """Add to the deviations what the tube moves between the pictures of a pair.

        Each camera saw it up to half the skew away from the pair's mean time; every quantity is taken to be off by its
        rate since the pair before, times that.
        """
        if self._before is None or not skew_s > 0 or not time_s > self._before[0]:
            return shape
        change = np.abs(_values(shape) - _values(self._before[1]))
        change[4] = min(change[4], 2 * math.pi - change[4])
        more = np.nan_to_num(change) / (time_s - self._before[0]) * skew_s / 2
        sd = {name: float(np.hypot(shape.sd[name], add)) for name, add in zip(SD_NAMES, more, strict=True)}
        return replace(shape, sd=sd)


def _corrected(predicted: Moving | None, time_s: float, position_mm: Array, covariance: Array) -> Moving:
    if predicted is None:
        return begin(time_s, position_mm, covariance, _SPEED_SD_MM_PER_S)
    return correct(predicted, position_mm, covariance)


def _values(shape: Shape) -> Array:
    """Values (7,) in the order of `SD_NAMES`."""
    rest = (shape.bending_rad, shape.orientation_rad, shape.length_mm, shape.curvature_per_mm)
    return np.array([*shape.tip_mm, *rest])


def _say(faults: Mapping[str, CameraFault]) -> tuple[str, ...]:
    words = {
        CameraFault.UNPLUGGED: "cannot be read; is it plugged in?",
        CameraFault.SILENT: "sends nothing",
        CameraFault.FROZEN: "sends the same picture again and again",
    }
    return tuple(f"{name} {words[fault]}" for name, fault in faults.items())
