"""The examples run."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from live_scenes import SIZE, wanted
from tubesight.core import InputError
from tubesight.sources.live import LiveCameras
from tubesight.sources.opening import open_source
from tubesight.tracking.pairing import PairingRule

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def load(path: str) -> ModuleType:
    file = EXAMPLES / path
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module
    spec.loader.exec_module(module)
    return module


def test_the_tip_follows_its_path_by_what_is_measured(tmp_path: Path) -> None:
    example = load("position_control.py")
    closed = example.run(0.25, 0.01, SIZE)
    open_loop = example.run(0.25, 0.0, SIZE, feedback=False)
    found, without = example.figures(closed), example.figures(open_loop)
    # A pixel is 1.1 mm at this size, and a tip is known to a quarter of it.
    assert found["noise_mm"] < 0.28
    # An integrator of 12 per second follows a circle of 0.5 Hz four times better than no feedback at all.
    assert found["error_mm"] < 0.5 * without["error_mm"]
    example.draw(tmp_path / "control.png", closed, open_loop, 0.01)
    assert (tmp_path / "control.png").stat().st_size > 10_000


def test_network_cameras_of_the_simulator_are_read() -> None:
    example = load("mjpeg_cameras.py")
    swing, rig = example.coded_swing(SIZE)
    with example.serve(swing, 30.0) as address:
        sources = {name: open_source(f"{address}/{name}", wanted(name)) for name in rig.names}
        with LiveCameras(sources, PairingRule(rig.names, 0.01)) as cameras:
            pairs = [cameras.take(5.0) for _ in range(5)]
    # Stamped with the same instants by the server; what is left is the difference of the shortest ways.
    assert all(pair is not None and pair.skew_s < 0.01 and pair.frames["left"].coded for pair in pairs)


def test_the_plug_in_is_a_camera() -> None:
    example = load("plugin_camera/pattern_camera.py")
    reader = example.source("pattern:200", wanted("left")).open()
    assert reader.read().image.shape == SIZE[::-1]
    with pytest.raises(InputError, match="expected pattern:HZ"):
        example.source("pattern:fast", wanted("left"))
    assert 'pattern = "pattern_camera:source"' in (EXAMPLES / "plugin_camera" / "pyproject.toml").read_text()
