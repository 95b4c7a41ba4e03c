"""What wrong base frames and calibrations cost: prints the tables of docs/uncertainty.md.

Run in the folder of the project: ``python docs/errors.py`` (two minutes). Simulated photographs (1920 x 1080, cameras
90 degrees apart at 0.31 m, with background pictures) of arcs of 30, 60 and 90 degrees are measured with the true rig
and with wrong ones; the difference is what the mistake costs, since everything else is the same.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from tubesight.apps.demo import run_demo
from tubesight.core import FramePair, Tip, Tube
from tubesight.files.rig import load_rig
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.sensor import Reconstruction, ShapeSensor
from tubesight.simulate import Arc, render_background, render_pair, rig_around

TUBE = Tube(12.0, Tip("ball", 16.0), clamped=True)
BENDS_DEG, AZIMUTHS_DEG = (30, 60, 90), (20, 140, 260)
Change = Callable[[Rig], Rig]


def turned(axis: str, degrees: float) -> Pose:
    """Turn about an axis of the base frame."""
    return Pose.from_rotvec(np.radians(degrees) * np.array([axis == name for name in "xyz"], float), np.zeros(3))


def moved(axis: str, mm: float) -> Pose:
    """Shift along an axis of the base frame."""
    return Pose(np.eye(3), mm * np.array([axis == name for name in "xyz"], float))


def base_off(true_from_assumed: Pose) -> Change:
    """Rig whose base frame is registered wrongly."""
    return lambda rig: replace(
        rig, camera_from_base={n: p @ true_from_assumed for n, p in rig.camera_from_base.items()}
    )


def parameter_off(name: str, delta: float) -> Change:
    """Rig with one parameter off."""
    return lambda rig: rig.perturbed(name, delta)


def camera_off(now_from_before: Pose) -> Change:
    """Rig whose left camera stands otherwise than the file says; axes are those of the camera."""

    def change(rig: Rig) -> Rig:
        return replace(
            rig, camera_from_base=rig.camera_from_base | {"left": now_from_before @ rig.camera_from_base["left"]}
        )

    return change


BASE: dict[str, Change] = {
    f"{what} {size} {unit}": base_off(make(axis, size))
    for what, make, axis, unit in (
        ("shifted across the tube by", moved, "x", "mm"),
        ("shifted along the tube by", moved, "z", "mm"),
        ("tilted by", turned, "x", "degrees"),
        ("turned about the tube by", turned, "z", "degrees"),
    )
    for size in (0.1, 0.5)
}
CAMERA: dict[str, Change] = {
    "principal point 1 px off": parameter_off("left.cx", 1.0),
    "focal length 0.1 % off": lambda rig: rig.perturbed("left.f", 1e-3 * rig.cameras["left"].focal_px),
    "k1 0.01 off": parameter_off("left.k1", 0.01),
    "turned by 0.05 degrees since": camera_off(turned("y", 0.05)),
    "moved by 0.1 mm since": camera_off(moved("x", 0.1)),
}


def pictures(rig: Rig, bends: tuple[int, ...] = BENDS_DEG, azimuths: tuple[int, ...] = AZIMUTHS_DEG) -> list[FramePair]:
    """Photographs of arcs of 150 mm."""
    arcs = [Arc(np.radians(bend), np.radians(azimuth), 150.0) for bend in bends for azimuth in azimuths]
    return [render_pair(rig, arc, TUBE, name=str(k)) for k, arc in enumerate(arcs)]


def differences(right: Reconstruction, wrong: Reconstruction) -> list[float]:
    """Tip in mm, bending and orientation in degrees, length in mm; NaN where one was not measured."""
    one, other = right.shape, wrong.shape
    if one is None or other is None:
        return [np.nan] * 4
    angles = np.degrees([other.bending_rad - one.bending_rad, other.orientation_rad - one.orientation_rad])
    angles = (angles + 180) % 360 - 180
    tip = float(np.linalg.norm(other.tip_mm - one.tip_mm))
    return [tip, *np.abs(angles).tolist(), abs(other.length_mm - one.length_mm)]


def table(title: str, changes: dict[str, Change], rig: Rig, pairs: list[FramePair], tube: Tube) -> Iterator[str]:
    """Lines of a table: largest differences over all pictures, the rms of the fit, and what was not measured."""
    yield f"| {title} | tip [mm] | bending [deg] | orientation [deg] | length [mm] | rms [px] | not measured |"
    yield "|---|---|---|---|---|---|---|"
    empty = render_background(rig, Arc(0.5, 0.0, 150.0)).images
    right = [ShapeSensor(rig, tube, backgrounds=empty)(pair) for pair in pairs]
    for name, change in {"nothing": lambda rig: rig, **changes}.items():
        sensor = ShapeSensor(change(rig), tube, backgrounds=empty)
        wrong = [sensor(pair) for pair in pairs]
        off = np.array([differences(a, b) for a, b in zip(right, wrong, strict=True)])
        measured = np.isfinite(off[:, 0])
        numbers = off[measured].max(0) if measured.any() else [np.nan] * 4
        rms = max((result.fit_rms_px for result in wrong if result), default=np.nan)
        cells = [f"{number:.2f}" for number in (*numbers, rms)]
        yield f"| {name} | {' | '.join(cells)} | {'' if measured.all() else f'{(~measured).sum()} of {len(pairs)}'} |"


def calibration_part(bends: tuple[int, ...] = BENDS_DEG) -> Iterator[str]:
    """Lines of the table of deviations from the covariance of a calibration from simulated photographs of a board."""
    with tempfile.TemporaryDirectory() as folder:
        run_demo(Path(folder))
        loaded = load_rig(Path(folder) / "rig.yaml")
    rig, rms = loaded.rig, (loaded.calibration or {})["rms_px"]
    yield f"| calibrated, RMS {rms:.3f} px | tip x, y, z [um] | bending [deg] | orientation [deg] | length [um] |"
    yield "|---|---|---|---|---|"
    true = rig_around(90.0)
    for bend, pair in zip(bends, pictures(true, bends, AZIMUTHS_DEG[:1]), strict=True):
        shape = ShapeSensor(rig, TUBE)(pair).shape
        if shape is None:
            raise SystemExit(f"the arc of {bend} degrees was not measured")
        sd = shape.sd_rig
        tip = ", ".join(f"{1e3 * sd[f'tip_{axis}']:.1f}" for axis in "xyz")
        angles = " | ".join(f"{np.degrees(sd[name]):.4f}" for name in ("bending", "orientation"))
        yield f"| arc of {bend} degrees | {tip} | {angles} | {1e3 * sd['length']:.1f} |"


def main() -> None:
    """Print all tables."""
    rig = rig_around(90.0)
    pairs = pictures(rig)
    for title, changes, tube in (
        ("base frame, clamped tube", BASE, TUBE),
        ("base frame, free tube", BASE, replace(TUBE, clamped=False)),
        ("one camera, clamped tube", CAMERA, TUBE),
    ):
        print(*table(title, changes, rig, pairs, tube), "", sep="\n")
    print(*calibration_part(), sep="\n")


if __name__ == "__main__":
    main()
