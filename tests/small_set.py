"""A small data set of simulated photographs, written in the formats of the project."""

import json
from pathlib import Path

import cv2
import numpy as np
import yaml

from tubesight.core import Tip, Tube
from tubesight.files.rig import save_rig
from tubesight.simulate.phantom import Arc, Phantom, straight, truth
from tubesight.simulate.render import render_background, render_pair
from tubesight.simulate.rigs import rig_around

SIZE = (960, 540)
TUBE = Tube(12.0, Tip("ball", 16.0), clamped=True)
PHANTOMS: dict[str, Phantom] = {
    "1": Arc(np.radians(40), np.radians(70), 150.0),
    "2": straight(150.0),
    "10": Arc(np.radians(60), np.radians(200), 150.0),
}


def write_small_set(folder: Path) -> Path:
    """Write `photos/{left,right}` with three pairs, rig.yaml, tube.yaml, truth.json and background/."""
    rig = rig_around(90.0, size_px=SIZE)
    save_rig(folder / "rig.yaml", rig)
    tube = {"diameter_mm": 12.0, "tip": {"shape": "ball", "diameter_mm": 16.0}, "clamped": True}
    (folder / "tube.yaml").write_text(yaml.safe_dump(tube), encoding="utf-8")
    frames = [{"frame": name} | truth(phantom) for name, phantom in PHANTOMS.items()]
    (folder / "truth.json").write_text(json.dumps({"units": "mm, deg", "frames": frames}), encoding="utf-8")
    pairs = {f"photos/{{}}/{name}.png": render_pair(rig, p, TUBE, name=name) for name, p in PHANTOMS.items()}
    pairs["background/{}/empty.png"] = render_background(rig, PHANTOMS["1"])
    for pattern, pair in pairs.items():
        for camera, image in pair.images.items():
            path = folder / pattern.format(camera)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), image)
    return folder
