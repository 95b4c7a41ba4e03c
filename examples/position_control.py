"""A simulated tendon robot follows a circle with its tip, controlled at 200 Hz by what the cameras measure.

    python examples/position_control.py -o position_control.png

Everything but the robot is real: every step photographs the robot with two simulated cameras, measures the photographs,
and passes the tip on to the controller after a stated delay. Time is simulated, since photographs take longer to render
than 5 ms. Shown are the path, the error of the measurement (its noise), and the error of the control, with and without
the feedback.
"""

from __future__ import annotations

import argparse
import math
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tubesight.sensor import ShapeSensor
from tubesight.simulate import Arc, render_pair
from tubesight.sources.simulated import SIM_TUBE, sim_rig

HZ, LENGTH_MM = 200.0, 150.0
# The robot: bending per millimetre of tendon, a first order lag, and friction: tendons pull 20 % short one way.
RAD_PER_MM, LAG_S, SHORT = 0.22, 0.03, 0.2
# The controller: an integrator on the tip, as fast as lag and delay allow without ringing (phase margin 65 degrees).
GAIN_PER_S = 12.0
# The path: a circle of this radius about this point, once in two seconds.
RADIUS_MM, CENTRE_MM, PERIOD_S = 15.0, np.array([45.0, 10.0]), 2.0


@dataclass
class Robot:
    """Two tendons bend the tube along x and y."""

    bend_rad: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def step(self, tendon_mm: np.ndarray) -> Arc:
        """Pull for one period, and return the shape then."""
        pulled = RAD_PER_MM * tendon_mm * np.array([1.0, 1.0 - SHORT])
        self.bend_rad = self.bend_rad + (pulled - self.bend_rad) * (1 - math.exp(-1 / (HZ * LAG_S)))
        return shape_of(self.bend_rad)


def shape_of(bend_rad: np.ndarray) -> Arc:
    """Arc that bends by this vector."""
    return Arc(float(np.hypot(*bend_rad)), float(np.arctan2(bend_rad[1], bend_rad[0])), LENGTH_MM)


def bend_for(tip_mm: np.ndarray) -> np.ndarray:
    """Bending of an arc whose tip is at (x, y): Newton's method on r = L (1 - cos theta) / theta."""
    r = float(np.hypot(*tip_mm))
    theta = 2 * r / LENGTH_MM
    for _ in range(8):
        off = LENGTH_MM * (1 - math.cos(theta)) / theta - r
        slope = LENGTH_MM * (theta * math.sin(theta) - 1 + math.cos(theta)) / theta**2
        theta -= off / slope
    return theta * tip_mm / r


def wanted_mm(time_s: float) -> np.ndarray:
    """Tip (x, y) of the path."""
    angle = 2 * math.pi * time_s / PERIOD_S
    return CENTRE_MM + RADIUS_MM * np.array([math.cos(angle), math.sin(angle)])


def run(seconds: float, delay_s: float, size_px: tuple[int, int], feedback: bool = True) -> dict[str, np.ndarray]:
    """Follow the path; tips wanted, true and measured at every step."""
    rig = sim_rig(size_px, ("left", "right"))
    sensor, robot = ShapeSensor(rig, SIM_TUBE), Robot()
    correction = np.zeros(2)
    late: deque[np.ndarray | None] = deque([None] * round(delay_s * HZ))
    # The robot begins on the path.
    robot.bend_rad = bend_for(wanted_mm(0.0)) * np.array([1.0, 1.0 - SHORT])
    rows = []
    for k in range(round(seconds * HZ)):
        time_s = k / HZ
        tendon_mm = (bend_for(wanted_mm(time_s)) + correction) / RAD_PER_MM
        shape = robot.step(tendon_mm)
        true = shape.at(LENGTH_MM)
        result = sensor(render_pair(rig, shape, SIM_TUBE, name=str(k))) if feedback else None
        measured = result.shape.tip_mm if result and result.shape is not None else np.full(3, np.nan)
        late.append(measured[:2] if result else None)
        known = late.popleft()
        # A pair that was not measured moves nothing: the last correction stays.
        if known is not None and feedback:
            behind = wanted_mm(time_s - delay_s)
            correction = correction + GAIN_PER_S / HZ * (bend_for(behind) - bend_for(known))
        rows.append((time_s, wanted_mm(time_s), true, measured))
    times, want, true, measured = (np.array(column) for column in zip(*rows, strict=True))
    return {"time_s": times, "wanted_mm": want, "true_mm": true, "measured_mm": measured}


def figures(found: dict[str, np.ndarray]) -> dict[str, float]:
    """Noise of the measurement and error of the control after the first quarter of a second, mm RMS."""
    late = found["time_s"] >= min(0.25, found["time_s"][-1] / 2)
    noise = found["measured_mm"] - found["true_mm"]
    error = np.linalg.norm(found["true_mm"][:, :2] - found["wanted_mm"], axis=1)
    return {
        "noise_mm": float(np.sqrt(np.nanmean((noise**2).sum(1)))) if np.isfinite(noise).any() else math.nan,
        "error_mm": float(np.sqrt(np.mean(error[late] ** 2))),
    }


def draw(path: Path, closed: dict[str, np.ndarray], open_loop: dict[str, np.ndarray], delay_s: float) -> None:
    """Path, measurement error and control error in one figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    way, noise, error = figure.subplots(1, 3)
    way.plot(*closed["wanted_mm"].T, color="0.6", linewidth=4, label="wanted")
    way.plot(*open_loop["true_mm"][:, :2].T, "--", color="tab:orange", label="without feedback")
    way.plot(*closed["true_mm"][:, :2].T, color="tab:blue", label="with feedback")
    way.set(xlabel="x [mm]", ylabel="y [mm]", title="tip", aspect="equal")
    way.legend(fontsize=8, loc="center")
    off = 1e3 * (closed["measured_mm"] - closed["true_mm"])
    for axis, name in enumerate("xyz"):
        noise.plot(closed["time_s"], off[:, axis], linewidth=0.8, label=name)
    noise.set(xlabel="time [s]", ylabel="measured - true [um]", title="measurement")
    noise.legend(fontsize=8)
    for found, name, colour in ((open_loop, "without feedback", "tab:orange"), (closed, "with feedback", "tab:blue")):
        distance = np.linalg.norm(found["true_mm"][:, :2] - found["wanted_mm"], axis=1)
        error.plot(found["time_s"], distance, color=colour, label=name)
    error.set(xlabel="time [s]", ylabel="tip to path [mm]", title=f"control, delay {1e3 * delay_s:.0f} ms")
    error.set_ylim(0)
    error.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--delay-ms", type=float, default=10.0, help="from the photograph to the controller")
    parser.add_argument("--size", default="480x270")
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    width, height = (int(n) for n in given.size.split("x"))
    closed = run(given.seconds, given.delay_ms / 1e3, (width, height))
    open_loop = run(given.seconds, 0.0, (width, height), feedback=False)
    with_it, without = figures(closed), figures(open_loop)
    print(f"measurement: {1e3 * with_it['noise_mm']:.0f} um RMS, delay {given.delay_ms:g} ms, {HZ:g} Hz")
    print(f"control: {with_it['error_mm']:.2f} mm RMS from the path, {without['error_mm']:.2f} mm without feedback")
    print("Research use only, not a medical device.")
    if given.out is not None:
        draw(given.out, closed, open_loop, given.delay_ms / 1e3)


if __name__ == "__main__":
    main()
