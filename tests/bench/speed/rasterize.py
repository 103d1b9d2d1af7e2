"""How fast one iteration is, against what this processor could do: `python -m tests.bench rasterize`.

The floor is arithmetic: the (pixel, Gaussian) pairs that the view blends, counted, times the 117 floating point
operations that a pair takes forward and backward, over the multiply-adds per second that a core was measured to do in
the same run. Ratios to it can be compared between machines and between busy and quiet hours; they are given for the
clock (all threads at work) and for processor time (all threads added up, which other programs disturb less).
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatnode.capture.cameras import folder, synthetic
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon import core, rasterize
from splatnode.recon.config import preset
from splatnode.recon.geometry import exp_se3, twist_gradient
from splatnode.recon.optimize.fit import Adam
from splatnode.recon.optimize.photometric_losses import PhotometricLoss
from splatnode.recon.pipeline import reconstruct
from splatnode.recon.rasterize.reference import CHANNELS
from splatnode.recon.scene import SH_C0

FLOPS_PER_PAIR = 117
LRS = {"means": 1.6e-3, "quats": 1e-2, "log_scales": 1e-2, "logit_opacities": 5e-2, "sh": 1e-1, "twist": 1e-4}
SIGMA_PX = {20_000: 3.0, 50_000: 2.0, 150_000: 1.5}  # of a Gaussian at 512 x 384, so that it overlaps its neighbours
REAL_SCENE = "fountain_p11"
REAL_VIEWS = 6


@dataclass(frozen=True, eq=False)
class Scene:
    """What is optimised, and what it is compared with."""

    params: dict[str, Tensor]  # named as `LRS`; leaves
    T_world_camera: Tensor  # (4, 4)
    K: Tensor  # (3, 3)
    target: Tensor  # (H, W, 3)
    lr_factor: float  # of `LRS`


@dataclass(frozen=True)
class Case:
    name: str
    gaussians: int
    width: int
    height: int
    channels: tuple[str, ...]


CASES = [
    *(Case(f"{count // 1000}k_512x384_all", count, 512, 384, CHANNELS) for count in SIGMA_PX),
    Case("20k_256x192_rgb", 20_000, 256, 192, ("rgb",)),
]


def bumpy_surface(case: Case, seed: int = 0) -> Scene:
    """A textured height field in front of three cameras, each of which contributes a third of the points."""
    generator = np.random.default_rng(seed)
    width, height, focal = case.width, case.height, 0.9 * case.width
    sigma_px = SIGMA_PX[case.gaussians] * width / 512
    means, depths = [], []
    for offset in (-0.5, 0.0, 0.5):
        count = case.gaussians // 3
        pixels = generator.random((count, 2)) * [width, height] - [width / 2, height / 2]
        rays = np.column_stack([pixels / focal, np.ones(count)])
        depth = np.full(count, 4.0)
        for _ in range(30):
            x, y = offset + depth * rays[:, 0], depth * rays[:, 1]
            depth += 0.5 * (
                4 + 0.35 * np.sin(2.1 * x) * np.cos(1.7 * y) + 0.15 * np.sin(5 * x) * np.sin(4.3 * y) - depth
            )
        means.append(depth[:, None] * rays + [offset, 0, 0])
        depths.append(depth)
    points, depth = np.concatenate(means), np.concatenate(depths)
    scales = (depth * sigma_px / focal)[:, None] * np.exp(0.3 * generator.normal(size=(len(depth), 3)))
    x, y = points[:, 0], points[:, 1]
    texture = np.column_stack([np.sin(9 * x), np.sin(7 * y + 2 * x), np.cos(23 * x - 9 * y)]) * 0.3 + 0.5
    arrays = {
        "means": points + 1e-3 * generator.normal(size=points.shape),
        "quats": generator.normal(size=(len(depth), 4)),
        "log_scales": np.log(scales),
        "logit_opacities": 1.5 * generator.normal(size=len(depth)),
        "sh": ((texture - 0.5) / SH_C0)[:, None],
        "twist": np.zeros((1, 6)),
    }
    params = {name: torch.tensor(array, dtype=torch.float32).requires_grad_() for name, array in arrays.items()}
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    noise = torch.tensor(generator.random((height, width, 3)), dtype=torch.float32)
    # Hardly moving: the work to be timed stays what it is.
    return Scene(params, torch.eye(4), K, noise, lr_factor=1e-6)


def reconstruction(frames: Sequence[Frame | DroppedFrame]) -> Scene:
    """What a preview makes of the frames, seen by their middle camera: real colours, sizes and overlaps."""
    *_, final = reconstruct(frames, preset("preview"))
    if not final.verdict.publishable:
        raise RuntimeError(f"the frames to time on must give a scene, but: {final.verdict.message}")
    gaussians, camera = final.gaussians, final.cameras[len(final.cameras) // 2]
    opacities = gaussians.opacities.clip(1e-6, 1 - 1e-6)
    arrays = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "log_scales": np.log(gaussians.scales),
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh": gaussians.sh,
        "twist": np.zeros((1, 6)),
    }
    params = {name: torch.tensor(array, dtype=torch.float32).requires_grad_() for name, array in arrays.items()}
    T_world_camera, K = (torch.tensor(array, dtype=torch.float32) for array in (camera.T_world_camera, camera.K))
    target = torch.tensor(final.images[camera.name] / 255.0, dtype=torch.float32)
    return Scene(params, T_world_camera, K, target, lr_factor=1e-6)


def real_frames(shared: Path) -> tuple[str, list[Frame | DroppedFrame]]:
    """Photographs of a real place where they are at hand, otherwise the built-in capture; and the name of which."""
    images = shared / "scenes" / REAL_SCENE / "images"
    if not images.is_dir():
        return "synthetic", list(synthetic.stream(synthetic.Config(views=REAL_VIEWS)))
    paths = folder.image_paths(images)
    chosen = np.linspace(0, len(paths) - 1, REAL_VIEWS).astype(int)
    return REAL_SCENE, list(folder.stream(folder.Config(images, names=tuple(paths[i].name for i in chosen))))


class Iteration:
    """One step of the optimisation: activations, image, loss, gradients, Adam. Keeps the seconds of each part."""

    def __init__(self, scene: Scene, channels: tuple[str, ...]):
        self.scene, self.channels = scene, channels
        self.loss = PhotometricLoss(scene.target)
        self.adam = Adam(scene.params, {name: scene.lr_factor * lr for name, lr in LRS.items()})
        self.T_world_camera = scene.T_world_camera.clone().requires_grad_()
        self.clock: dict[str, float] = {}
        self.processors: dict[str, float] = {}
        height, width, _ = scene.target.shape
        generator = torch.Generator().manual_seed(1)
        # Stand-ins for the gradients of losses on the other channels, as small as those are.
        shapes = {"depth": (height, width), "normal": (3, height, width), "alpha": (height, width)}
        self.upstream = {
            name: 1e-7 * torch.randn(shape, generator=generator) for name, shape in shapes.items() if name in channels
        }
        if "normal" in self.upstream:
            self.upstream["normal"] = self.upstream["normal"].permute(1, 2, 0)

    def step(self) -> float:
        """Returns the loss."""
        params = self.scene.params
        start = _Marks(self)
        scales, opacities = params["log_scales"].exp(), params["logit_opacities"].sigmoid()
        start.mark("activations")
        height, width, _ = self.scene.target.shape
        render = rasterize.rasterize_on_cpu(
            params["means"], params["quats"], scales, opacities, params["sh"], self.T_world_camera, self.scene.K,
            width, height, channels=self.channels,
        )  # fmt: skip
        assert render.rgb is not None and render.rgb.grad_fn is not None
        raster = render.rgb.grad_fn.raster  # pyright: ignore[reportAttributeAccessIssue]
        start.mark("forward")
        loss = self.loss(render.rgb)
        start.mark("loss")
        outputs = [loss, *(getattr(render, name) for name in self.upstream)]
        torch.autograd.backward(outputs, [torch.ones(()), *self.upstream.values()])
        start.mark("backward")
        self._move()
        start.mark("adam")
        self.raster = raster
        clock, processors = raster.seconds()
        self.clock |= clock
        self.processors |= processors
        return loss.item()

    def _move(self) -> None:
        twist = self.scene.params["twist"]
        assert self.T_world_camera.grad is not None
        with torch.no_grad():
            twist.zero_()
            twist.grad = twist_gradient(self.T_world_camera, self.T_world_camera.grad)[None]
            self.adam.step()
            self.T_world_camera.copy_(self.T_world_camera @ exp_se3(twist[0]))
        self.adam.zero_grad()
        self.T_world_camera.grad = None


class _Marks:
    def __init__(self, owner: Iteration):
        self.owner, self.clock, self.processors = owner, time.perf_counter(), time.process_time()

    def mark(self, name: str) -> None:
        clock, processors = time.perf_counter(), time.process_time()
        self.owner.clock[name], self.owner.processors[name] = clock - self.clock, processors - self.processors
        self.clock, self.processors = clock, processors


def measure(scene: Scene, channels: tuple[str, ...], peak: float, rounds: int) -> dict:
    iteration = Iteration(scene, channels)
    for _ in range(3):
        iteration.step()
    clock, processors, clocks, works = [], [], [], []
    for _ in range(rounds):
        start, work = time.perf_counter(), time.process_time()
        iteration.step()
        clock.append(1e3 * (time.perf_counter() - start))
        processors.append(1e3 * (time.process_time() - work))
        clocks.append(dict(iteration.clock))
        works.append(dict(iteration.processors))
    pairs = _count("core_raster_pairs", iteration.raster)
    blocks = _count("core_raster_block_pairs", iteration.raster)
    threads = core.library().core_get_threads()
    floor = 1e3 * pairs * FLOPS_PER_PAIR / peak
    return {
        "gaussians": len(scene.params["means"]),
        "width": scene.target.shape[1],
        "height": scene.target.shape[0],
        "channels": list(channels),
        "pairs": pairs,
        "lanes_used": pairs / (blocks * core.library().core_lanes()),
        "entries": _count("core_raster_entries", iteration.raster),
        "floor_processor_ms": floor,
        "floor_clock_ms": floor / threads,
        "clock_ms": _summary(clock),
        "processor_ms": _summary(processors),
        "iterations_per_s": 1e3 / float(np.median(clock)),
        "ratio_clock": min(clock) / (floor / threads),
        "ratio_processor": min(processors) / floor,
        "stages_clock_ms": {name: _summary([1e3 * one[name] for one in clocks]) for name in clocks[0]},
        "stages_processor_ms": {name: _summary([1e3 * one[name] for one in works]) for name in works[0]},
    }


def _summary(values: list[float]) -> dict[str, float]:
    return {"min": round(min(values), 3), "median": round(float(np.median(values)), 3)}


def _count(function: str, raster: object) -> int:
    count: Callable = getattr(core.library(), function)
    count.restype = ctypes.c_int64  # pyright: ignore[reportFunctionMemberAccess]
    return count(raster.handle)  # pyright: ignore[reportAttributeAccessIssue]


def peak_flops() -> float:
    """Of one core, the best of five."""
    function = core.library().core_peak_flops
    function.restype = ctypes.c_double
    return max(function() for _ in range(5))


def processor_name() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor()


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench rasterize", description=__doc__)
    parser.add_argument("--out", type=Path, help="where to write the figures as JSON")
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--threads", type=int, default=core.default_threads())
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("SPLATNODE_SHARED", "../shared")))
    arguments = parser.parse_args()
    core.set_threads(arguments.threads)
    # Torch does only small things here, and its threads spin while they wait: on a busy machine that costs tens of ms.
    torch.set_num_threads(1)

    peak = peak_flops()
    report: dict = {
        "command": f"python -m tests.bench rasterize --rounds {arguments.rounds} --threads {arguments.threads}",
        "machine": {
            "processor": processor_name(),
            "lanes": core.library().core_lanes(),
            "instruction_set": core.instruction_sets()[0],
            "threads": arguments.threads,
            "peak_gflops_per_core": peak / 1e9,
            "load_average": os.getloadavg()[0],
            "torch": torch.__version__,
        },
        "cases": {},
    }
    scenes = {case.name: (bumpy_surface(case), case.channels) for case in CASES}
    name, frames = real_frames(arguments.shared)
    real = reconstruction(frames)
    scenes |= {f"{name}_all": (real, CHANNELS), f"{name}_rgb": (real, ("rgb",))}
    print(f"{core.instruction_sets()[0]}, {arguments.threads} threads, {peak / 1e9:.0f} GFLOP/s a core")
    for name, (scene, channels) in scenes.items():
        result = measure(scene, channels, peak, arguments.rounds)
        report["cases"][name] = result
        stages = {stage: value["min"] for stage, value in result["stages_processor_ms"].items()}
        print(
            f"{name:20s} {result['clock_ms']['min']:6.1f} ms (median {result['clock_ms']['median']:.1f}, "
            f"{result['ratio_clock']:.2f} x floor), processors {result['processor_ms']['min']:.1f} ms "
            f"({result['ratio_processor']:.2f} x)  {stages}"
        )
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
