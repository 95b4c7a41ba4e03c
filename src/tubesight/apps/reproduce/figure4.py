"""Figure 4: what each stage of the paper's image processing makes of a photograph, and what each stage of ours does."""

from __future__ import annotations

from dataclasses import replace

from tubesight.apps.reproduce.mockup import TUBE, phantom_of, photograph, true_rig
from tubesight.apps.reproduce.study import Context, Figure, StudyResult
from tubesight.outputs.stages import write_stages
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Scene

# A pose like that of the paper's figure, bent across the first camera's view.
_BENDING_DEG, _ORIENTATION_DEG = 50.0, 60.0


def run(context: Context) -> StudyResult:
    """Draw the stages of `reference` and of `silhouette` for one photograph of the first camera."""
    rig = true_rig()
    camera = rig.names[0]
    scene = Scene(seed=context.seed_of("scene"))
    pair = photograph(rig, phantom_of(_BENDING_DEG, _ORIENTATION_DEG), scene, "figure4")
    figures = []
    for method, caption in (
        ("reference", "Stages of the paper, (a) to (l) as in its figure 4, by the method reference."),
        ("silhouette", "Stages of the method silhouette on the same photograph."),
    ):
        sensor = ShapeSensor(rig, TUBE, method)
        result = replace(sensor(pair), frame=f"figure4_{method}")
        files = write_stages(context.out / "figures", pair, result, sensor)
        sheet = next(path for path in files if path.name == f"{camera}.png")
        figures.append(Figure(sheet, caption))
    text = (
        f"A rendered photograph of a tube bent by {_BENDING_DEG:.0f} degrees at an orientation of "
        f"{_ORIENTATION_DEG:.0f} degrees goes through the image processing of the paper (figure 4) and through that "
        f"of tubesight. Shown is the camera {camera}."
    )
    return StudyResult("Figure 4: stages of the image processing", (text,), tuple(figures))
