"""``tubesight warmup``."""

from __future__ import annotations


def command() -> None:
    """Compile what results need and keep it on disk, so that no measurement waits for it.

    tubesight warmup
    """
    from rich.progress import Progress

    from tubesight.apps.warmup import warm_up
    from tubesight.cli.console import remark, stderr, stdout
    from tubesight.core.kernels import COMPILED, FOLDER

    if not COMPILED:
        remark(["nothing is compiled here: no folder for compiled code can be written, or it is switched off"])
        return
    with Progress(console=stderr(), transient=True) as bar:
        task = bar.add_task("compiling", total=None)
        warmed = warm_up(lambda name, k, n: bar.update(task, description=name, completed=k, total=n))
    taken = sum(step.seconds for step in warmed)
    stdout().print(f"compiled code is ready in {FOLDER} ({taken:.0f} s)", soft_wrap=True)
    remark(f"{step.name}: no shape; run `tubesight doctor`" for step in warmed if not step.ok)
