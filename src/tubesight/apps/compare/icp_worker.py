"""Runs icpReconstructor on one pair of masks, in the interpreter of the environment that has it.

Started as a script of its own (``python icp_worker.py JOB.npz RESULT.json``): nothing of tubesight is imported here,
and nothing of tubesight imports this. Lengths are metres, the unit for which the package's steps are made.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np


def main(job_path: str, result_path: str) -> None:
    """Fit as the package is shipped, then with the one name set that its fit lacks."""
    import torch
    from icpReconstructor import torch_reconstruction

    torch.set_num_threads(1)
    torch.manual_seed(0)
    with np.load(job_path) as job:
        data = {name: job[name] for name in job.files}
    results = {"as_shipped": fitted(torch, torch_reconstruction, data)}
    if "error" in results["as_shipped"]:
        torch_reconstruction.verbose = False
        torch.manual_seed(0)
        results["patched"] = fitted(torch, torch_reconstruction, data)
    with open(result_path, "w", encoding="utf-8") as file:
        json.dump(results, file)


def fitted(torch: Any, package: Any, data: dict[str, Any]) -> dict[str, Any]:
    """Points (N, 3) of the fitted curve in metres with the seconds it took, or the error."""
    length = torch.tensor([float(data["length_m"])])
    cameras = [
        {
            "A": torch.tensor(data[f"matrix{k}"]).float(),
            "dist": torch.tensor(data[f"distortion{k}"]).float(),
            "P": torch.tensor(data[f"projection{k}"]).float(),
            "R_cam0_world": torch.eye(3),
            "T_cam0_world": torch.zeros(3, 1),
        }
        for k in range(int(data["cameras"]))
    ]
    pixels = [data[f"pixels{k}"] for k in range(len(cameras))]
    start = time.process_time()
    try:
        model = package.TorchMovingFrame(length)
        estimator = package.TorchCurveEstimator(model, cameras, float(length))
        estimator.fit(pixels, n_iter=int(data["iterations"]))
        model.set_funs()
        with torch.no_grad():
            points = model(torch.linspace(0.0, float(length), 101)).numpy()
    except Exception as error:
        return {"error": f"{type(error).__name__}: {error}"}
    return {"points_m": points.tolist(), "seconds": time.process_time() - start}


if __name__ == "__main__":
    main(*sys.argv[1:])
