"""``tubesight simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    scene: Annotated[Path, typer.Argument(help="What to photograph: `scene.yaml`.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the data set; must be new or empty.")],
) -> None:
    """Photograph tubes of known shape: a data set with pictures, boards, rig and truth.

    tubesight simulate scene.yaml -o simulated
    """
    from tubesight.apps.scene_file import load_scene
    from tubesight.apps.simulate import write_dataset
    from tubesight.cli.calibrate import bar
    from tubesight.cli.console import stdout
    from tubesight.core import InputError

    plan = load_scene(scene)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there already; name a new folder with -o")
    with bar() as report:
        write_dataset(out, plan, lambda done, total: report("photographs", done, total))
    stdout().print(f"{len(plan.phantoms)} pairs of photographs and their truth in {out}/")
