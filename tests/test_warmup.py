"""What runs before and around the first result: warm-up, the folder of compiled code, memory, planes of YUYV."""

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tubesight.apps import memory
from tubesight.apps.warmup import warm_up
from tubesight.cli.main import app
from tubesight.core import FramePair, Image, Tip, Tube
from tubesight.core.kernels import COMPILED, FOLDER
from tubesight.outputs import machine
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Arc, render_pair, rig_around
from tubesight.vision import entry_kernels
from tubesight.vision.entry_kernels import Entry

TUBE = Tube(12.0, Tip("ball", 16.0), clamped=True)


def test_everything_that_is_warmed_gives_a_shape() -> None:
    told: list[tuple[str, int, int]] = []
    warmed = warm_up(lambda *step: told.append(step))
    assert [step.name for step in warmed if not step.ok] == []
    assert [k for _, k, _ in told] == list(range(len(warmed) + 1))
    assert {n for _, _, n in told} == {len(warmed)}


@pytest.mark.skipif(not COMPILED, reason="nothing is compiled here")
def test_no_picture_waits_for_a_compiler_after_warming_up() -> None:
    """Nor one whose tube is covered and seen stage by stage, in the middle of a live session."""
    warm_up()
    waiting = [name for name, each in vars(entry_kernels).items() if isinstance(each, Entry) and not each.ready]
    assert waiting == []


@pytest.mark.skipif(not COMPILED, reason="nothing is compiled here")
def test_command_tells_the_folder() -> None:
    result = CliRunner().invoke(app, ["warmup"])
    assert result.exit_code == 0
    assert str(FOLDER) in result.stdout


FOLDER_OF = "from tubesight.core.kernels import COMPILED, FOLDER; print(COMPILED, FOLDER)"


def folder_with(**variables: str) -> list[str]:
    """Whether code is compiled in a fresh process, and the folder it is kept in."""
    done = subprocess.run(
        [sys.executable, "-c", FOLDER_OF], env=os.environ | variables, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_compiled_code_goes_where_it_is_told(tmp_path: Path) -> None:
    compiled, folder = folder_with(NUMBA_CACHE_DIR=str(tmp_path / "told"))
    assert compiled == "True" and Path(folder).parent == tmp_path / "told"


def test_code_that_was_not_used_for_long_is_removed(tmp_path: Path) -> None:
    fresh, old, other = (tmp_path / name for name in ("kernels-fresh", "kernels-old", "somebody-elses"))
    for folder, days in ((fresh, 1), (old, 40), (other, 40)):
        folder.mkdir()
        (folder / "code.nbi").touch()
        os.utime(folder, (time.time() - days * 86400,) * 2)
    _, used = folder_with(NUMBA_CACHE_DIR=str(tmp_path))
    assert {p.name for p in tmp_path.iterdir()} == {"kernels-fresh", "somebody-elses", Path(used).name}


def test_a_folder_that_cannot_be_written_is_passed_over(tmp_path: Path) -> None:
    """A file stands where the folder should be: that stops root too."""
    (tmp_path / "file").write_text("")
    compiled, folder = folder_with(NUMBA_CACHE_DIR=str(tmp_path / "file"))
    assert compiled == "True" and Path(folder).is_dir() and tmp_path not in Path(folder).parents


@pytest.mark.parametrize("method", ["silhouette", "cone_ray"])
def test_a_plane_of_yuyv_needs_no_copy(method: str) -> None:
    """The Y plane as it lies in its buffer gives what a gray picture gives, and is only read."""
    rig = rig_around(90.0, size_px=(960, 540))
    gray: dict[str, Image] = {}
    planes: dict[str, Image] = {}
    for name, image in render_pair(rig, Arc(0.7, 1.0, 160.0), TUBE).images.items():
        gray[name] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        buffer = np.full((*image.shape[:2], 2), 128, np.uint8)
        buffer[..., 0] = gray[name]
        buffer.flags.writeable = False
        planes[name] = buffer[..., 0]
        assert not planes[name].flags.c_contiguous
    sensor = ShapeSensor(rig, TUBE, method)
    one, other = sensor(FramePair(gray)), sensor(FramePair(planes))
    assert one.shape is not None and other.shape is not None
    np.testing.assert_array_equal(one.shape.tip_mm, other.shape.tip_mm)


def test_memory_is_that_of_a_process_of_its_own() -> None:
    rig = rig_around(90.0, size_px=(960, 540))
    alone = memory.alone_mb(rig, TUBE, render_pair(rig, Arc(0.7, 1.0, 160.0), TUBE), "cone_ray")
    if Path("/proc/self/statm").exists():
        assert 30 < alone < 400


def test_memory_where_the_system_tells_less(monkeypatch: pytest.MonkeyPatch) -> None:
    def unread(*_: object, **__: object) -> str:
        raise OSError

    monkeypatch.setattr(machine.Path, "read_text", unread)
    largest = machine.resident_mb()
    assert math.isnan(largest) or largest > 30
    monkeypatch.setitem(sys.modules, "resource", None)
    assert math.isnan(machine.resident_mb())


def test_soak_tells_the_slope() -> None:
    result = CliRunner().invoke(app, ["bench", "--soak", "20", "--method", "cone_ray", "--json"])
    assert result.exit_code == 0
    printed = json.loads(result.stdout)
    assert printed["pairs"] == 20
    assert set(printed) == {"pairs", "first_mb", "last_mb", "bytes_per_pair"}


@pytest.mark.parametrize(("grows_mb", "slope"), [(0.0, 0.0), (2.0, 2e6)])
def test_slope_is_that_of_the_looks(monkeypatch: pytest.MonkeyPatch, grows_mb: float, slope: float) -> None:
    looks = iter(range(1000))
    monkeypatch.setattr(memory, "resident_mb", lambda: 100.0 + grows_mb * next(looks))
    grown = memory.soak(lambda pair: None, [FramePair({})], 50)  # type: ignore[arg-type]
    # The fit of a line to 50 looks: a few roundings.
    assert grown.bytes_per_pair == pytest.approx(slope, abs=1e-3)


def test_module_is_the_command_line() -> None:
    done = subprocess.run([sys.executable, "-m", "tubesight", "--version"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith("tubesight ")
