"""The examples of docs/reference/commands.md, run one after the other in a folder with what they speak of."""

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer

from tubesight.cli.main import app, main
from tubesight.core import Tip, Tube
from tubesight.files.rig import load_rig
from tubesight.simulate import Arc, Phantom, render_pair, straight
from tubesight.simulate.scene import Scene

TESTS = Path(__file__).resolve().parent
PAGE = (TESTS.parent / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
# What shortens an example whose usual form takes minutes; the last of two equal options counts.
SHORTER = {
    "demo": ["--quick"],
    "bench": ["--pairs", "2"],
    "compare": ["--methods", "cone_ray"],
    "view": ["--pairs", "1", "--port", "0"],
}
# Examples that name cameras, files that others write, or studies of minutes run in tests of their own with others.
ELSEWHERE = ("capture", "import", "live", "record", "replay", "recover", "export", "soak", "reproduce", "plan")
ROD = Tube(8.0, Tip("flat"), clamped=True)


def examples() -> list[list[str]]:
    """Words of each example, in the order of the page."""
    text = "\n".join(re.findall(r"^```bash\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL))
    lines = (shlex.split(line) for line in text.splitlines())
    return [words[1:] for words in lines if words and words[0] == "tubesight"]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_an_example_that_some_test_runs(name: str) -> None:
    assert f"\ntubesight {name}" in PAGE.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
    pattern = re.compile(rf"""["']{name}["' ]""")
    here = Path(__file__).name
    assert any(pattern.search(t.read_text(encoding="utf-8")) for t in TESTS.glob("test_*.py") if t.name != here)


def prepare() -> None:
    """Put what the examples name where they name it, from the data of the demo."""
    demo = Path("demo-out")
    for name in ("calibration", "registration"):
        shutil.copytree(demo / "data" / name, name)
    shutil.copytree(demo / "data" / "registration", "today")
    for camera in ("left", "right"):
        for folder in (Path("photos"), Path("monday") / "photos", Path("tuesday") / "photos"):
            shutil.copytree(demo / "data" / camera, folder / camera)
    for name in ("registration.yaml", "tube.yaml", "truth.json"):
        shutil.copy(demo / "data" / name, name)
    rig = load_rig(demo / "data" / "rig_true.yaml").rig
    bent = Arc(np.radians(40), 0.0, 150.0)
    for folder, phantom, tube in (("rod", straight(150.0), ROD), ("bent", bent, Tube(12.0, Tip("ball", 16.0)))):
        photograph(rig, phantom, tube, folder)
    places = np.random.default_rng(0).uniform([-40, -40, 20], [40, 40, 140], (12, 3))
    pixels = np.concatenate([rig.project(name, places) for name in rig.names], 1)
    head = ["name", *(f"{axis}_mm" for axis in "xyz"), *(f"{name}_{axis}_px" for name in rig.names for axis in "xy")]
    rows = [",".join([f"p{k}", *map(str, row)]) for k, row in enumerate(np.concatenate([places, pixels], 1).tolist())]
    Path("points.csv").write_text("\n".join([",".join(head), *rows]), encoding="utf-8")
    cameras = ["--source", "left=sim:", "--source", "right=sim:", "--size", "480x270", "--seconds", "1"]
    assert leave(["record", *cameras, "-o", "session.mcap"]) == 0
    blocks = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    Path("scene.yaml").write_text(next(block for block in blocks if "shapes:" in block), encoding="utf-8")


def photograph(rig: Any, phantom: Phantom, tube: Tube, folder: str) -> None:
    for camera, image in render_pair(rig, phantom, tube, Scene()).images.items():
        path = Path(folder) / camera / "000.png"
        path.parent.mkdir(parents=True)
        cv2.imwrite(str(path), image)


def leave(args: list[str]) -> int:
    with pytest.raises(SystemExit) as left:
        main(args)
    return int(left.value.code or 0)


@pytest.mark.slow
def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each exits with 0; what the doctor says of this machine is not the page's concern."""
    monkeypatch.chdir(tmp_path)
    done = []
    for words in examples():
        if words[0] in ELSEWHERE:
            continue
        if words[:2] == ["run", "--config"]:
            shutil.copy(Path("lab") / "run.yaml", "run.yaml")
        assert leave([*words, *SHORTER.get(words[0], [])]) == 0 or words[0] == "doctor", words
        done.append(words[0])
        if words[0] == "demo":
            prepare()
        if words[0] == "board":
            # The demo photographed another board than the example prints.
            shutil.copy("demo-out/data/board.yaml", "board.yaml")
    assert {"demo", "init", "calibrate", "register", "check", "run", "evaluate", "simulate"} <= set(done)
