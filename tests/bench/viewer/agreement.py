"""How far apart the pictures of Open3D and of the project's own rasteriser are."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatnode.recon.result.rendering import render_arrays
from splatnode.viewer.sources import load_result
from splatnode.viewer.state import ViewerState


def agreement(result: Path) -> dict:
    """Differences between the engines' pictures on black, in levels of 255, at the result's cameras."""
    from open3d.visualization import rendering  # pyright: ignore[reportMissingImports]

    from splatnode.viewer.stage import Scene3D

    moment = load_result(result)
    cameras, gaussians = moment.snapshot.cameras, moment.snapshot.gaussians
    width, height = cameras[0].width, cameras[0].height
    renderer = rendering.OffscreenRenderer(width, height)
    scene = Scene3D(renderer.scene)
    scene.set_drawing(True)
    scene.show_gaussians(gaussians, ViewerState())
    renderer.scene.set_background([0.0, 0.0, 0.0, 1.0])
    rows = []
    for camera in cameras:
        extrinsics = np.linalg.inv(camera.T_world_camera)
        renderer.setup_camera(camera.K, extrinsics, width, height)
        theirs = np.asarray(renderer.render_to_image()).astype(float)
        ours = 255.0 * np.clip(render_arrays(gaussians, camera.T_world_camera, camera.K, width, height).rgb, 0, 1)
        shifts = {f"{x},{y}": float(np.abs(np.roll(theirs, (y, x), (0, 1)) - ours)[4:-4, 4:-4].mean())
                  for x in (-1, 0, 1) for y in (-1, 0, 1)}  # fmt: skip
        difference = np.abs(theirs - ours)
        rows.append(
            {
                "camera": camera.name,
                "mean": round(float(difference.mean()), 3),
                "share_above_16": round(float((difference.max(2) > 16).mean()), 4),
                "bias": round(float((theirs - ours).mean()), 3),
                "best_shift_px": min(shifts, key=lambda shift: shifts[shift]),
            }
        )
    return {"mean": round(float(np.mean([row["mean"] for row in rows])), 3), "cameras": rows}
