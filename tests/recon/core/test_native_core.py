"""The compiled core without Python around it: under address and undefined-behaviour sanitizers, and as aarch64."""

from __future__ import annotations

import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from splatnode.recon.core import instruction_sets
from splatnode.recon.core.compile import FLAGS, INSTRUCTION_SETS, machine
from splatnode.recon.rasterize import reference
from tests.conftest import ROOT
from tests.support.rasterize_cases import HEIGHT, NAMES, WIDTH, Case, image_weights, images, needles, random_case

CORE = ROOT / "recon" / "core"
SOURCES = [
    *(CORE / f"{name}.cpp" for name in ("project", "bin", "tile", "blend", "blend_backward", "project_backward")),
    *(CORE / f"{name}.cpp" for name in ("rasterize", "photometric", "match", "threads")),
    ROOT / "tests" / "native" / "check_core.cpp",
]


def build(compiler: str, folder: Path, *flags: str) -> Path:
    """Compiles the core and its checks into one program."""

    def compile_one(source: Path) -> str:
        output = str(folder / f"{source.stem}.o")
        command = [compiler, *FLAGS, *flags, f"-I{CORE}", "-c", str(source), "-o", output]
        result = subprocess.run(command, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        return output

    with ThreadPoolExecutor(max_workers=2) as pool:
        objects = list(pool.map(compile_one, SOURCES))
    program = folder / "check_core"
    subprocess.run([compiler, *flags, "-pthread", *objects, "-o", str(program)], check=True)
    return program


def write_case(path: Path, case: Case, antialias: bool) -> None:
    """The case and what the float64 reference makes of it, as check_core.cpp reads them."""
    tensors = case.tensors()
    rendered = images(reference.rasterize(*tensors, width=WIDTH, height=HEIGHT, antialias=antialias))
    weights = image_weights(rendered)
    torch.stack([(image * weight).sum() for image, weight in zip(rendered, weights, strict=True)]).sum().backward()
    gradients = {name: tensor.grad.numpy() for name, tensor in zip(NAMES, tensors, strict=True)}  # pyright: ignore
    K, K_gradient = case.K.numpy(), gradients["K"]

    def planar(image: torch.Tensor) -> np.ndarray:
        image = image.detach()
        return (image.permute(2, 0, 1) if image.dim() == 3 else image).numpy().ravel()

    with path.open("wb") as file:
        np.array([len(case.means), case.sh.shape[1], WIDTH, HEIGHT, antialias], np.int32).tofile(file)
        case.T_world_camera.numpy().tofile(file)
        np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]).tofile(file)
        floats = [getattr(case, name).numpy() for name in ("means", "quats", "scales", "opacities", "sh")]
        floats += [planar(weight) for weight in weights] + [planar(image) for image in rendered]
        floats += [gradients[name] for name in ("means", "quats", "scales", "opacities", "sh", "T_world_camera")]
        floats += [np.array([K_gradient[0, 0], K_gradient[1, 1], K_gradient[0, 2], K_gradient[1, 2]])]
        for array in floats:
            array.astype(np.float32).tofile(file)


@pytest.fixture(scope="module")
def cases(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("cases")
    paths = []
    for name, case, antialias in (("random", random_case(21), False), ("needles", needles(22), True)):
        paths.append(folder / name)
        write_case(paths[-1], case, antialias)
    return paths


def run(command: list[str]) -> None:
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


def test_sanitizers_find_nothing(tmp_path, cases):
    compiler = shutil.which("g++") or pytest.skip("needs g++ with the sanitizers' libraries")
    best = next(iter(instruction_sets()), "baseline")
    sanitizers = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer", "-O1", "-g")
    program = build(compiler, tmp_path, *INSTRUCTION_SETS.get(machine(), {}).get(best, []), *sanitizers)
    run([str(program)])
    for case in cases:
        run([str(program), str(case)])


@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS["aarch64"])
def test_aarch64_equals_the_reference(tmp_path, cases, instruction_set):
    compiler = shutil.which("aarch64-linux-gnu-g++") or pytest.skip(
        "needs an aarch64 compiler (apt-get install g++-aarch64-linux-gnu)"
    )
    emulator = shutil.which("qemu-aarch64") or shutil.which("qemu-aarch64-static")
    if emulator is None:
        pytest.skip("needs an aarch64 emulator (apt-get install qemu-user)")
    program = build(compiler, tmp_path, "-static", *INSTRUCTION_SETS["aarch64"][instruction_set])
    run([emulator, str(program)])
    for case in cases:
        run([emulator, str(program), str(case)])
