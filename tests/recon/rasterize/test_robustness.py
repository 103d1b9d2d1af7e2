"""Rasterisers in threads, interleaved, at extreme sizes, and with input that is wrong."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from splatnode.recon import core, rasterize
from splatnode.recon.rasterize import reference
from tests.support.rasterize_cases import HEIGHT, NAMES, WIDTH, images, random_case, render_and_differentiate, single


def test_the_result_does_not_depend_on_threads():
    case = random_case(5, count=3000)
    before = core.library().core_get_threads()
    results = []
    try:
        for threads in (1, 2, 5, 2):
            core.set_threads(threads)
            rendered, gradients = render_and_differentiate(rasterize.rasterize_on_cpu, case)
            results.append(rendered + gradients)
    finally:
        core.set_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_gradients_can_be_taken_twice_and_interleaved():
    case = random_case(6)
    first, second = case.tensors(), case.tensors()
    a = rasterize.rasterize_on_cpu(*first, width=WIDTH, height=HEIGHT).rgb
    b = rasterize.rasterize_on_cpu(*second, width=2 * WIDTH, height=HEIGHT).rgb
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
        "from splatnode.recon.rasterize import rasterize_on_cpu\n"
        "from tests.support.rasterize_cases import random_case\n"
        "tensors = random_case(0, count=2000).tensors(torch.float32)\n"
        "def peak():\n"
        "    for _ in range(10): rasterize_on_cpu(*tensors, width=640, height=480).rgb.mean().backward()\n"
        "    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "start = peak(); peak(); print(peak() - start)\n"
    )
    grown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert int(grown.stdout) < 20_000  # kB; a leaked raster and its images would be 20 times 5 MB


def test_no_gaussians_give_the_empty_image():
    empty = [torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 1, 3)]
    leaves = [tensor.requires_grad_() for tensor in empty]
    T_world_camera = torch.eye(4).requires_grad_()
    render = rasterize.rasterize_on_cpu(*leaves, T_world_camera, single()[-1], width=33, height=20)
    assert all(image.abs().max() == 0 for image in images(render))
    assert render.rgb.shape == (20, 33, 3)
    render.rgb.sum().backward()
    assert leaves[0].grad.shape == (0, 3)
    assert T_world_camera.grad.abs().max() == 0


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 2), (33, 1), (1, 65)])
def test_small_images(width, height):
    case = random_case(8)
    expected = reference.rasterize(*case.tensors(), width=width, height=height)
    actual = rasterize.rasterize_on_cpu(*case.tensors(), width=width, height=height)
    for image, expected_image in zip(images(actual), images(expected), strict=True):
        torch.testing.assert_close(image.double(), expected_image, rtol=1e-4, atol=1e-5)


def test_a_large_image():
    tensors = random_case(9, count=500, width=4096, height=3072).tensors(torch.float32)
    render = rasterize.rasterize_on_cpu(*tensors, width=4096, height=3072, channels=("rgb",))
    assert render.rgb.shape == (3072, 4096, 3)
    render.rgb.mean().backward()
    assert torch.isfinite(tensors[0].grad).all() and tensors[0].grad.abs().max() > 0


def test_a_million_gaussians():
    tensors = random_case(10, count=1_000_000, bases=1).tensors(torch.float32)
    tensors[2] = (tensors[2].detach() * 0.05).requires_grad_()
    render = rasterize.rasterize_on_cpu(*tensors, width=128, height=96, channels=("rgb",))
    render.rgb.mean().backward()
    assert render.rgb.max() > 0 and torch.isfinite(tensors[0].grad).all()


def test_layout_and_dtype_do_not_matter():
    case = random_case(12)
    expected = rasterize.rasterize_on_cpu(*case.tensors(torch.float32), width=WIDTH, height=HEIGHT).rgb
    strided = [tensor.detach().mT.contiguous().mT if tensor.dim() > 1 else tensor for tensor in case.tensors()]
    assert not strided[0].is_contiguous()
    assert torch.equal(rasterize.rasterize_on_cpu(*strided, width=WIDTH, height=HEIGHT).rgb, expected)


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
        rasterize.rasterize_on_cpu(*tensors.values(), width=WIDTH, height=HEIGHT)


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
        rasterize.rasterize_on_cpu(*case.tensors(), **{"width": WIDTH, "height": HEIGHT, **options})


def test_wild_values_stay_finite():
    """Huge, tiny and far away: what cannot be drawn is not, and nothing becomes NaN."""
    case = random_case(14)
    tensors = case.tensors(torch.float32)
    with torch.no_grad():
        tensors[2][:50] = 1e15
        tensors[2][50:100] = 1e-30
        tensors[0][100:120] *= 1e12
        tensors[4][120:130] *= 1e20
    render = rasterize.rasterize_on_cpu(*tensors, width=WIDTH, height=HEIGHT)
    assert all(torch.isfinite(image).all() for image in images(render))
    render.alpha.sum().backward()
    assert all(torch.isfinite(tensor.grad).all() for tensor in tensors if tensor.grad is not None)
