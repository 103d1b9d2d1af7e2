"""The rasterisers against their definition, and the definition against finite differences."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from recon import core
from recon.rasterize import cpu, native, reference
from recon.rasterize.render import Render

NAMES = ("means", "quats", "scales", "opacities", "sh", "T_world_camera", "K")
WIDTH, HEIGHT = 46, 37  # more than one tile, not multiples of a block
COUNT = 120


@dataclass(frozen=True, eq=False)
class Case:
    """Gaussians and a camera, in float64 but exactly representable in float32."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    T_world_camera: Tensor
    K: Tensor

    def tensors(self, dtype: torch.dtype = torch.float64) -> list[Tensor]:
        return [getattr(self, name).clone().to(dtype).requires_grad_() for name in NAMES]


def random_case(seed: int, count: int = COUNT, bases: int = 16, width: int = WIDTH, height: int = HEIGHT) -> Case:
    """Gaussians of about 8 pixels around a camera's optical axis; some are behind it, some beside its view."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    T_world_camera = torch.eye(4, dtype=torch.float64)
    T_world_camera[:3, :3] = reference.rotations(torch.tensor([[1.0, 0, 0, 0]]).double() + 0.1 * normal(1, 4))[0]
    T_world_camera[:3, 3] = 0.2 * normal(3)
    K = torch.tensor([[0.9 * width, 0, 0.51 * width], [0, 0.93 * width, 0.48 * height], [0, 0, 1]]).double()
    return rounded(
        means=normal(count, 3) * torch.tensor([1.5, 1.1, 1.5]) + torch.tensor([0, 0, 4.0]),
        quats=normal(count, 4),
        scales=(normal(count, 3) * 0.6 - 2.2).exp(),
        opacities=torch.sigmoid(2 * normal(count)),
        sh=0.4 * normal(count, bases, 3),
        T_world_camera=T_world_camera,
        K=K,
    )


def rounded(**tensors: Tensor) -> Case:
    return Case(**{name: tensor.float().double() for name, tensor in tensors.items()})


def changed(case: Case, **changes: Tensor) -> Case:
    return rounded(**{**{name: getattr(case, name) for name in NAMES}, **changes})


def needles(seed: int) -> Case:
    case = random_case(seed)
    scales = case.scales.clone()
    scales[:, 0], scales[:, 1:] = 0.5, 0.002
    return changed(case, scales=scales)


def pancakes(seed: int) -> Case:
    case = random_case(seed)
    scales = case.scales.clone()
    scales[:, 2] = 1e-5
    return changed(case, scales=scales)


def at_the_border(seed: int) -> Case:
    case = random_case(seed)
    means = case.means.clone()
    means[:, 0] = means[:, 2] * torch.where(means[:, 1] > 0, 0.56, -0.56)
    return changed(case, means=means)


def behind_and_near(seed: int) -> Case:
    case = random_case(seed)
    means = case.means.clone()
    means[: COUNT // 2, 2] -= 4
    return changed(case, means=means)


def nearly_clear_and_nearly_opaque(seed: int) -> Case:
    case = random_case(seed)
    opacities = torch.where(torch.arange(COUNT) % 2 == 0, 1 / 255 + 1e-3, 0.9999)
    return changed(case, opacities=opacities)


def equal_depths(seed: int) -> Case:
    """In the camera's own axes, so that equal depths are equal after rounding too."""
    case = random_case(seed)
    means = case.means.clone()
    means[:, 2] = 3 + (torch.arange(COUNT) // 12) * 0.25
    return changed(case, means=means, T_world_camera=torch.eye(4))


CASES: list[Callable[[int], Case]] = [
    random_case, needles, pancakes, at_the_border, behind_and_near, nearly_clear_and_nearly_opaque, equal_depths,
]  # fmt: skip
TWENTY_SCENES = [(CASES[seed % len(CASES)], seed) for seed in range(21)]


def images(render: Render) -> list[Tensor]:
    return [image for image in (render.rgb, render.depth, render.normal, render.alpha) if image is not None]


def image_weights(shape_like: list[Tensor]) -> list[Tensor]:
    generator = torch.Generator().manual_seed(7)
    return [torch.randn(image.shape, generator=generator, dtype=torch.float64) for image in shape_like]


def render_and_differentiate(
    rasterize, case: Case, dtype=torch.float64, **options
) -> tuple[list[Tensor], list[Tensor]]:
    """The images and the gradients of their product with fixed random weights."""
    tensors = case.tensors(dtype)
    rendered = images(rasterize(*tensors, width=WIDTH, height=HEIGHT, **options))
    weighted = [(image * weight).sum() for image, weight in zip(rendered, image_weights(rendered), strict=True)]
    torch.stack(weighted).sum().backward()
    return [image.detach() for image in rendered], [
        torch.zeros_like(tensor) if tensor.grad is None else tensor.grad for tensor in tensors
    ]


def relative_error(actual: Tensor, expected: Tensor) -> float:
    return float((actual - expected).norm() / expected.norm().clamp(min=1e-12))


@pytest.mark.parametrize(("make", "seed"), TWENTY_SCENES, ids=lambda value: getattr(value, "__name__", str(value)))
@pytest.mark.parametrize("antialias", [False, True], ids=["plain", "antialias"])
def test_cpu_equals_the_reference(make, seed, antialias):
    case = make(seed)
    expected_images, expected = render_and_differentiate(reference.rasterize, case, antialias=antialias)
    actual_images, actual = render_and_differentiate(cpu.rasterize, case, antialias=antialias)
    for image, expected_image in zip(actual_images, expected_images, strict=True):
        assert relative_error(image, expected_image) < 2e-5
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        assert relative_error(gradient, expected_gradient) < 1e-4, name


@pytest.mark.parametrize("bases", [1, 4, 9, 16])
def test_every_degree_of_spherical_harmonics(bases):
    case = random_case(3, bases=bases)
    _, expected = render_and_differentiate(reference.rasterize, case, channels=("rgb",))
    _, actual = render_and_differentiate(cpu.rasterize, case, channels=("rgb",))
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        assert relative_error(gradient, expected_gradient) < 1e-4, name


@pytest.mark.parametrize(
    "channels", [("rgb",), ("depth",), ("normal",), ("alpha",), ("rgb", "depth"), ("normal", "depth")]
)
def test_channels_are_the_same_alone(channels):
    case = random_case(4)
    whole = cpu.rasterize(*case.tensors(), width=WIDTH, height=HEIGHT)
    part = cpu.rasterize(*case.tensors(), width=WIDTH, height=HEIGHT, channels=channels)
    for name in reference.CHANNELS:
        if name in channels:
            torch.testing.assert_close(getattr(part, name), getattr(whole, name))
        else:
            assert getattr(part, name) is None
    _, expected = render_and_differentiate(reference.rasterize, case, channels=channels)
    _, actual = render_and_differentiate(cpu.rasterize, case, channels=channels)
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        if expected_gradient.norm() == 0:
            assert gradient.norm() == 0, name
        else:
            assert relative_error(gradient, expected_gradient) < 1e-4, name


def test_the_definition_passes_gradcheck():
    """Finite differences in float64, of the camera's pose and focal length among the rest."""
    case = random_case(0, count=3, bases=4, width=8, height=8)
    case = changed(case, scales=case.scales * 3, opacities=case.opacities * 0.5 + 0.2)

    def rendered(*tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(images(reference.rasterize(*tensors, width=8, height=8, antialias=True)))

    assert torch.autograd.gradcheck(rendered, case.tensors(), eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("parameter", ["T_world_camera", "K"])
def test_cpu_camera_gradient_against_finite_differences_of_the_definition(parameter):
    case = random_case(11, count=60)
    generator = torch.Generator().manual_seed(1)
    if parameter == "K":
        direction = torch.tensor([[1.0, 0, 0.3], [0, -0.7, 0.2], [0, 0, 0]]).double()
    else:
        turn = torch.randn(3, generator=generator, dtype=torch.float64)
        x, y, z = turn.tolist()
        tangent = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]).double()
        direction = torch.zeros(4, 4).double()
        direction[:3, :3] = case.T_world_camera[:3, :3] @ tangent
        direction[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)

    def loss(value: Tensor) -> float:
        moved = {name: getattr(case, name) for name in NAMES} | {parameter: value}
        rendered = images(reference.rasterize(*moved.values(), width=WIDTH, height=HEIGHT, channels=("rgb", "alpha")))
        return float(sum((image * image).sum() for image in rendered))

    tensors = case.tensors()
    rendered = images(cpu.rasterize(*tensors, width=WIDTH, height=HEIGHT, channels=("rgb", "alpha")))
    torch.stack([(image * image).sum() for image in rendered]).sum().backward()
    gradient = tensors[NAMES.index(parameter)].grad
    assert gradient is not None
    step = 1e-6
    start = getattr(case, parameter)
    slope = (loss(start + step * direction) - loss(start - step * direction)) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(slope, rel=5e-4)


def single(mean=(0.0, 0.0, 2.0), opacity=0.5, scale=0.1) -> list[Tensor]:
    """One round white Gaussian in front of a camera with its principal point on a pixel's centre."""
    sh = torch.full((1, 1, 3), 0.5 / 0.28209479177387814)
    K = torch.tensor([[20.0, 0, 8.5], [0, 20, 8.5], [0, 0, 1]])
    return [
        torch.tensor([mean]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), scale), torch.tensor([opacity]),
        sh, torch.eye(4), K,
    ]  # fmt: skip


@pytest.mark.parametrize("rasterize", [reference.rasterize, cpu.rasterize], ids=["reference", "cpu"])
def test_one_gaussian_by_hand(rasterize):
    render = rasterize(*single(), width=17, height=17)
    variance = (20 * 0.1 / 2) ** 2 + 0.3
    assert render.rgb[8, 8, 0].item() == pytest.approx(0.5, rel=1e-5)
    assert render.alpha[8, 9].item() == pytest.approx(0.5 * math.exp(-0.5 / variance), rel=1e-5)
    assert render.depth[8, 8].item() == pytest.approx(2.0, rel=1e-5)
    assert render.depth[0, 0].item() == 0
    torch.testing.assert_close(render.normal[8, 8], torch.tensor([-0.5, 0.0, 0.0]).abs() * render.normal[8, 8].sign())
    filtered = rasterize(*single(), width=17, height=17, antialias=True)
    assert filtered.rgb[8, 8, 0].item() == pytest.approx(0.5 * (variance - 0.3) / variance, rel=1e-5)


@pytest.mark.parametrize("rasterize", [reference.rasterize, cpu.rasterize], ids=["reference", "cpu"])
@pytest.mark.parametrize(
    ("mean", "seen"),
    [
        ((0.0, 0.0, -2.0), False),
        ((0.0, 0.0, 0.04), False),
        ((0.0, 0.0, 0.06), True),
        ((-1.3, 0.0, 2.0), True),  # projects to x = -4.5; the guard is at -5.1
        ((-1.4, 0.0, 2.0), False),
    ],
)
def test_near_plane_and_frustum_guard(rasterize, mean, seen):
    render = rasterize(*single(mean, opacity=0.9, scale=0.5), width=17, height=17, near=0.05)
    assert (render.alpha.max().item() > 0) == seen


@pytest.mark.parametrize("instruction_set", core.instruction_sets())
def test_instruction_sets_agree(instruction_set, monkeypatch):
    monkeypatch.setattr(native, "library", lambda: core.library(instruction_set))
    case = needles(1)
    expected_images, expected = render_and_differentiate(reference.rasterize, case)
    actual_images, actual = render_and_differentiate(cpu.rasterize, case)
    for image, expected_image in zip(actual_images, expected_images, strict=True):
        assert relative_error(image, expected_image) < 2e-5
    for name, gradient, expected_gradient in zip(NAMES, actual, expected, strict=True):
        assert relative_error(gradient, expected_gradient) < 1e-4, name


def test_the_result_does_not_depend_on_threads():
    case = random_case(5, count=3000)
    before = core.library().core_get_threads()
    results = []
    try:
        for threads in (1, 2, 5, 2):
            core.set_threads(threads)
            rendered, gradients = render_and_differentiate(cpu.rasterize, case)
            results.append(rendered + gradients)
    finally:
        core.set_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_gradients_can_be_taken_twice_and_interleaved():
    case = random_case(6)
    first, second = case.tensors(), case.tensors()
    a = cpu.rasterize(*first, width=WIDTH, height=HEIGHT).rgb
    b = cpu.rasterize(*second, width=2 * WIDTH, height=HEIGHT).rgb
    assert a is not None and b is not None
    a.sum().backward(retain_graph=True)
    once = first[0].grad.clone()
    b.sum().backward()
    a.sum().backward()
    torch.testing.assert_close(first[0].grad, 2 * once)
    del a, b


def test_rasters_are_given_back():
    """The core keeps two idle rasters; many renders must not grow the process."""
    script = (
        "import resource, torch\n"
        "from tests.test_rasterize import random_case, cpu\n"
        "tensors = random_case(0, count=2000).tensors(torch.float32)\n"
        "def peak():\n"
        "    for _ in range(30): cpu.rasterize(*tensors, width=640, height=480).rgb.mean().backward()\n"
        "    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "start = peak(); peak(); print(peak() - start)\n"
    )
    grown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert int(grown.stdout) < 20_000  # kB; a leaked raster and its images would be 60 times 5 MB


def test_no_gaussians_give_the_empty_image():
    empty = [torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 1, 3)]
    leaves = [tensor.requires_grad_() for tensor in empty]
    T_world_camera = torch.eye(4).requires_grad_()
    render = cpu.rasterize(*leaves, T_world_camera, single()[-1], width=33, height=20)
    assert all(image.abs().max() == 0 for image in images(render))
    assert render.rgb.shape == (20, 33, 3)
    render.rgb.sum().backward()
    assert leaves[0].grad.shape == (0, 3)
    assert T_world_camera.grad.abs().max() == 0


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 2), (33, 1), (1, 65)])
def test_small_images(width, height):
    case = random_case(8)
    expected = reference.rasterize(*case.tensors(), width=width, height=height)
    actual = cpu.rasterize(*case.tensors(), width=width, height=height)
    for image, expected_image in zip(images(actual), images(expected), strict=True):
        torch.testing.assert_close(image.double(), expected_image, rtol=1e-4, atol=1e-5)


def test_a_large_image():
    tensors = random_case(9, count=500, width=4096, height=3072).tensors(torch.float32)
    render = cpu.rasterize(*tensors, width=4096, height=3072, channels=("rgb",))
    assert render.rgb.shape == (3072, 4096, 3)
    render.rgb.mean().backward()
    assert torch.isfinite(tensors[0].grad).all() and tensors[0].grad.abs().max() > 0


def test_a_million_gaussians():
    tensors = random_case(10, count=1_000_000, bases=1).tensors(torch.float32)
    tensors[2] = (tensors[2].detach() * 0.05).requires_grad_()
    render = cpu.rasterize(*tensors, width=128, height=96, channels=("rgb",))
    render.rgb.mean().backward()
    assert render.rgb.max() > 0 and torch.isfinite(tensors[0].grad).all()


def test_layout_and_dtype_do_not_matter():
    case = random_case(12)
    expected = cpu.rasterize(*case.tensors(torch.float32), width=WIDTH, height=HEIGHT).rgb
    strided = [tensor.detach().mT.contiguous().mT if tensor.dim() > 1 else tensor for tensor in case.tensors()]
    assert not strided[0].is_contiguous()
    assert torch.equal(cpu.rasterize(*strided, width=WIDTH, height=HEIGHT).rgb, expected)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("means", lambda x: x * float("nan"), "means must be finite"),
        ("means", lambda x: x[:, :2], r"means must be \(N, 3\), got \(120, 2\)"),
        ("means", lambda x: x.long(), "means must be a tensor of floats, got torch.int64"),
        ("means", lambda x: x.numpy(), "means must be a tensor of floats, got ndarray"),
        ("quats", lambda x: x * 0, "quats must be finite and not of zero length"),
        ("quats", lambda x: x[:7], r"quats must be \(N, 4\) \(N = 120 from means\), got \(7, 4\)"),
        ("scales", lambda x: -x, "scales must be finite and not negative"),
        ("scales", lambda x: x / 0, "scales must be finite"),
        ("opacities", lambda x: x + 1.5, "opacities must be from 0 to 1"),
        ("opacities", lambda x: x[:, None], r"opacities must be \(120,\)"),
        ("sh", lambda x: x + float("inf"), "sh must be finite"),
        ("sh", lambda x: x[:, :3], r"sh must be \(120, B, 3\) with B in"),
        ("T_world_camera", lambda x: x * 2, "T_world_camera must be a rigid transform"),
        ("T_world_camera", lambda x: x * float("nan"), "T_world_camera must be finite"),
        ("K", lambda x: -x, "positive focal lengths"),
        ("K", lambda x: x + torch.tensor([[0, 0.5, 0], [0, 0, 0], [0, 0, 0]]), r"K must be \[\[fx, 0, cx\]"),
    ],
)
def test_bad_input_is_named(name, change, message):
    case = random_case(13)
    tensors = {key: getattr(case, key) for key in NAMES}
    tensors[name] = change(tensors[name])
    with pytest.raises(ValueError, match=message):
        cpu.rasterize(*tensors.values(), width=WIDTH, height=HEIGHT)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "width must be an integer from 1"),
        ({"height": 20000}, "height must be an integer from 1"),
        ({"width": 3.5}, "width must be an integer"),
        ({"channels": ("rgb", "colour")}, "channels must be some of"),
        ({"channels": ()}, "channels must be some of"),
        ({"near": 0.0}, "near must be positive"),
    ],
)
def test_bad_options_are_named(options, message):
    case = random_case(13)
    with pytest.raises(ValueError, match=message):
        cpu.rasterize(*case.tensors(), **{"width": WIDTH, "height": HEIGHT, **options})


def test_wild_values_stay_finite():
    """Huge, tiny and far away: what cannot be drawn is not, and nothing becomes NaN."""
    case = random_case(14)
    tensors = case.tensors(torch.float32)
    with torch.no_grad():
        tensors[2][:50] = 1e15
        tensors[2][50:100] = 1e-30
        tensors[0][100:120] *= 1e12
        tensors[4][120:130] *= 1e20
    render = cpu.rasterize(*tensors, width=WIDTH, height=HEIGHT)
    assert all(torch.isfinite(image).all() for image in images(render))
    render.alpha.sum().backward()
    assert all(torch.isfinite(tensor.grad).all() for tensor in tensors if tensor.grad is not None)
