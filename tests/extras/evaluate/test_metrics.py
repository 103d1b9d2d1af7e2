"""Image metrics against values worked out elsewhere."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy.signal import convolve2d

from splatnode.extras.evaluate.protocol import psnr, ssim
from splatnode.recon.networks.lpips import load_lpips


def random_image(seed: int, height: int = 20, width: int = 27) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def test_psnr_of_a_constant_difference():
    image = torch.full((4, 5, 3), 0.5)
    assert psnr(image, image + 0.1) == pytest.approx(20.0, abs=1e-4)
    assert psnr(image, image + 0.01) == pytest.approx(40.0, abs=1e-3)
    assert psnr(image, image) == pytest.approx(100.0)


def test_ssim_equals_a_plain_two_dimensional_implementation():
    a, b = random_image(0), random_image(1) * 0.4 + random_image(0) * 0.5
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for x, y in zip(a.double().numpy().transpose(2, 0, 1), b.double().numpy().transpose(2, 0, 1), strict=True):
        mx, my, mxx, myy, mxy = (convolve2d(v, window, "same") for v in (x, y, x * x, y * y, x * y))
        top = (2 * mx * my + 1e-4) * (2 * (mxy - mx * my) + 9e-4)
        values.append(top / ((mx**2 + my**2 + 1e-4) * (mxx - mx**2 + myy - my**2 + 9e-4)))
    assert ssim(a, b) == pytest.approx(np.mean(values), abs=1e-12)


def test_ssim_is_one_for_equal_images_and_symmetric():
    a, b = random_image(0), random_image(1)
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-12)
    assert ssim(a, b) == pytest.approx(ssim(b, a), abs=1e-12)
    assert ssim(a, b) < 0.3


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_images_of_different_shapes_are_refused(metric):
    with pytest.raises(ValueError, match=r"must both be \(H, W, 3\)"):
        metric(random_image(0), random_image(0)[1:])
    with pytest.raises(ValueError, match=r"must both be \(H, W, 3\)"):
        metric(random_image(0).permute(2, 0, 1), random_image(0).permute(2, 0, 1))


def read_example(shared, name: str) -> torch.Tensor:
    pixels = cv2.imread(str(shared / "weights" / "lpips" / "example" / f"{name}.png"))
    assert pixels is not None
    return torch.from_numpy(np.ascontiguousarray(pixels[..., ::-1])).float() / 255


@pytest.mark.parametrize(("network", "first", "second"), [("alex", 0.7219, 0.1376), ("vgg", 0.5686, 0.4217)])
def test_lpips_gives_the_published_values_with_the_published_weights(shared, network, first, second):
    lpips = load_lpips(network, shared / "weights")
    if lpips is None:
        pytest.skip(f"needs the LPIPS weights of {network}")
    reference = read_example(shared, "ex_ref")
    assert lpips(reference, read_example(shared, "ex_p0")) == pytest.approx(first, abs=1e-4)
    assert lpips(reference, read_example(shared, "ex_p1")) == pytest.approx(second, abs=1e-4)
    assert lpips(reference, reference) == 0.0
    with pytest.raises(ValueError, match="at least 32x32"):
        lpips(reference[:30], reference[:30])


def test_lpips_without_weights_is_not_measured(tmp_path, monkeypatch):
    assert load_lpips("alex", tmp_path) is None
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path / "absent"))
    assert load_lpips("vgg") is None


def test_lpips_weights_of_something_else_are_a_clear_error(tmp_path):
    torch.save({"net.0.weight": torch.zeros(1)}, tmp_path / "lpips_alex.pth")
    with pytest.raises(ValueError, match="checkpoint of LPIPS's network 'alex'"):
        load_lpips("alex", tmp_path)
