"""The tutorial's commands, run one after the other as a reader would, on simulated pictures."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from shared_data import shared
from tubesight.cli.main import main
from tubesight.files.rig import load_rig
from tubesight.files.tables import read_shapes

TUTORIAL = Path(__file__).resolve().parents[1] / "docs" / "tutorial.md"


def commands() -> list[list[str]]:
    """Words of each command line in the tutorial's blocks."""
    text = "\n".join(re.findall(r"^```bash\n(.*?)^```", TUTORIAL.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL))
    parts = [part for line in text.splitlines() for part in line.split("&&")]
    return [words for part in parts if (words := shlex.split(part))]


def leave(args: list[str]) -> int:
    """Exit code of the command line."""
    with pytest.raises(SystemExit) as left:
        main(args)
    return int(left.value.code or 0)


def photograph(lab: Path, data: Path) -> None:
    """Put the simulated pictures and what is known of them where a reader's own would be."""
    for name in ("calibration", "registration"):
        shutil.copytree(data / name, lab / name)
    for camera in ("left", "right"):
        shutil.copytree(data / camera, lab / "photos" / camera)
    for name in ("board.yaml", "registration.yaml", "tube.yaml"):
        shutil.copy(data / name, lab / name)


@pytest.mark.slow
def test_tutorial_from_first_to_last_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = []
    for words in commands():
        if words[0] == "make":
            continue
        if words[0] == "mkdir":
            (tmp_path / words[1]).mkdir()
        elif words[0] == "cd":
            monkeypatch.chdir(tmp_path / words[1])
        else:
            assert words[0] == "tubesight"
            code = leave(words[1:])
            # What the doctor says of this machine is not the tutorial's concern.
            assert code == 0 or words[1] == "doctor", words
            done.append(words[1])
        if done and done[-1] == "init":
            assert {p.name for p in Path().iterdir()} == {
                *("board.pdf", "board.yaml", "tube.yaml", "registration.yaml", "run.yaml")
            }
            photograph(Path(), tmp_path / "demo-out" / "data")
            done.append("photographs")
    assert done.count("calibrate") == done.count("register") == 2
    assert {"doctor", "demo", "board", "init", "devices", "evaluate"} <= set(done)
    # All three pages of numbers come from the same pictures: equal but for the chosen method.
    frames = [row.frame for row in read_shapes(tmp_path / "results" / "shapes.csv")]
    for folder, method in (("results", "silhouette"), ("results-closed-form", "cone_ray")):
        rows = read_shapes(Path(folder) / "shapes.csv")
        assert [row.frame for row in rows] == frames
        assert {row.method for row in rows} == {method}
    assert list(Path("results/overlay").glob("*.png"))


@pytest.mark.slow
def test_tutorial_by_hand_on_the_mock_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Section 2 with a folder of photographs in place of the simulated ones; the calibration is most of the time."""
    data = shared("mockup")
    monkeypatch.chdir(tmp_path)
    mine = [
        [word.replace("demo-out/data", str(data)) for word in words[1:]]
        for words in commands()
        if any("demo-out/data" in word for word in words)
    ]
    assert [args[0] for args in mine] == ["calibrate", "register", "run", "evaluate"]
    for args in mine[:2]:
        assert leave(args) == 0
    assert load_rig(Path("rig.yaml")).rig.registered
    # Two pairs are enough to see that the numbers come out.
    for camera in ("left", "right"):
        pictures = tmp_path / "few" / camera
        pictures.mkdir(parents=True)
        for path in sorted((data / camera).iterdir())[:2]:
            shutil.copy(path, pictures)
    run = [str(tmp_path / "few") if word == str(data) else word for word in mine[2]]
    assert leave(run) == 0
    assert leave(mine[3]) == 0
    assert all(row.status == "ok" for row in read_shapes(Path("results/shapes.csv")))
