"""The documentation is true: its snippets run, its commands exist, its files load, its links lead somewhere."""

import re
import shlex
from pathlib import Path
from typing import Any

import cv2
import pytest
import typer

from small_set import write_small_set
from tubesight.apps.planning.config import load_plan
from tubesight.apps.run_config import load_run_config
from tubesight.apps.scene_file import load_scene
from tubesight.cli.main import app
from tubesight.core import Status
from tubesight.files.board import load_board
from tubesight.files.registration import load_points, load_registration
from tubesight.files.rig import load_rig
from tubesight.files.tables import COLUMNS
from tubesight.files.tube import load_tube
from tubesight.sensor import DEFAULT_METHOD

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
IDS = [str(page.relative_to(ROOT)) for page in PAGES]
_FENCE = re.compile(r"^([ \t]*)```(\w+)\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
# Options of the program itself, which typer adds.
COMPLETION = ("--install-completion", "--show-completion")
COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a page in a language, without their indentation."""
    found = _FENCE.findall(page.read_text(encoding="utf-8"))
    return [re.sub(rf"^{indent}", "", text, flags=re.MULTILINE) for indent, kind, text in found if kind == language]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the pages speak of: photos, rig.yaml and tube.yaml."""
    folder = write_small_set(tmp_path_factory.mktemp("docs"))
    for path in list(folder.glob("photos/*/*.png")):
        if path.stem == "1":
            cv2.imwrite(str(path.with_name("0000.jpg")), cv2.imread(str(path)))
        path.unlink()
    return folder


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=lambda p: p.name)
def test_python_snippets_run(page: Path, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(data)
    names: dict[str, Any] = {}
    for snippet in blocks(page, "python"):
        exec(compile(snippet, str(page), "exec"), names)
    if "result" in names:
        assert names["result"].status is Status.OK


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_commands_in_blocks_are_right_usage(page: Path) -> None:
    for block in blocks(page, "bash"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] != ["tubesight"] or words[1] in COMPLETION:
                continue
            assert words[1] in COMMANDS, line
            COMMANDS[words[1]].make_context(words[1], words[2:])


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_commands_in_the_text_exist(page: Path) -> None:
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    for quoted in re.findall(r"`tubesight ([^`]+)`", text):
        words = quoted.split()
        if words[0] in ("--help", "--version", "COMMAND", *COMPLETION):
            continue
        assert words[0] in COMMANDS, quoted
        known = {option for parameter in COMMANDS[words[0]].params for option in parameter.opts}
        assert {word for word in words[1:] if word.startswith("-")} <= known | {"--help"}, quoted


@pytest.mark.parametrize("page", PAGES, ids=IDS)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http://", "https://", "mailto:")):
            assert (page.parent / target).exists(), target


def test_every_command_status_and_column_is_documented() -> None:
    reference = ROOT / "docs" / "reference"
    commands, files, status = ((reference / f"{name}.md").read_text() for name in ("commands", "files", "status"))
    for name in COMMANDS:
        assert f"`tubesight {name}" in commands
    for name, command in COMMANDS.items():
        section = commands.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
        options = {option for parameter in command.params for option in parameter.opts if option.startswith("--")}
        for option in options - {"--help"}:
            assert option in section, f"{name} {option}"
    assert f"| one of `tubesight methods` | `{DEFAULT_METHOD}` |" in commands
    for column in COLUMNS:
        assert f"`{column}`" in files
    for code in Status:
        assert f"| `{code}` | {code.advice}" in status
        assert code is Status.OK or f"`{code}`" in (ROOT / "docs" / "how-to" / "mend.md").read_text()


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "yaml")], ids=lambda p: p.name)
def test_example_files_load(page: Path, tmp_path: Path) -> None:
    """Each YAML example is a whole file of the format its keys tell."""
    path = tmp_path / "example.yaml"
    for example in blocks(page, "yaml"):
        path.write_text(example, encoding="utf-8")
        if "shapes:" in example:
            load_scene(path)
        elif "rig_path:" in example:
            load_run_config(path)
        elif "workspace:" in example:
            load_plan(path)
        elif "cameras:" in example:
            load_rig(path)
        elif "views:" in example:
            load_registration(path)
        elif "squares:" in example:
            load_board(path)
        else:
            load_tube(path)


def test_example_points_load(tmp_path: Path) -> None:
    (table,) = [text for text in blocks(ROOT / "docs" / "reference" / "files.md", "text") if text.startswith("name")]
    (tmp_path / "points.csv").write_text(table, encoding="utf-8")
    assert load_points(tmp_path / "points.csv").names == ("corner",)


def test_version_is_the_same_everywhere() -> None:
    from tubesight import __version__

    for name, line in (("pyproject.toml", f'version = "{__version__}"'), ("CITATION.cff", f"version: {__version__}")):
        assert line in (ROOT / name).read_text(encoding="utf-8")
    assert f"## {__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
