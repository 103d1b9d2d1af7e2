"""MASt3R's network against golden values of the authors' implementation, and its checkpoints against trickery.

The weights are generated from their names (../shared/golden/README.md), so no trained weights are needed.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from splatnode.recon.networks import check_names_and_shapes
from splatnode.recon.networks.vit import Rotary, grid_positions
from splatnode.recon.priors.mast3r import Mast3r, Size, load_network
from tests.support.generated import generated, generated_weights, shapes_of

TINY = Size(encoder_width=96, encoder_depth=3, encoder_heads=6, decoder_width=64, decoder_depth=12, decoder_heads=4)
SMALLEST = Size(encoder_width=32, encoder_depth=1, encoder_heads=2, decoder_width=32, decoder_depth=4, decoder_heads=2)


@pytest.fixture(scope="module")
def smallest() -> dict[str, torch.Tensor]:
    return generated_weights(partial(Mast3r, SMALLEST))


@pytest.mark.parametrize("orientation", ["landscape", "portrait"])
def test_outputs_equal_the_golden_values(shared, tmp_path, orientation):
    golden = np.load(shared / "golden" / "mast3r_tiny_golden.npz")
    shapes = json.loads((shared / "golden" / "mast3r_tiny_state_dict.json").read_text())
    torch.save({name: generated(name, tuple(shape)) for name, shape in shapes.items()}, tmp_path / "tiny.pth")
    network = load_network(tmp_path / "tiny.pth", TINY)
    with torch.no_grad():
        first, second = (network.encode(torch.from_numpy(golden[f"{orientation}_img{i}"])) for i in (1, 2))
        np.testing.assert_allclose(first.tokens.numpy(), golden[f"{orientation}_enc1"], atol=2e-5)
        np.testing.assert_array_equal(first.positions.numpy(), golden[f"{orientation}_pos1"])
        views = network.decode(first, second)
    for view, points, prediction in zip((1, 2), ("pts3d", "pts3d_in_other_view"), views, strict=True):
        outputs = {
            points: prediction.points,
            "conf": prediction.confidence,
            "desc": prediction.descriptors,
            "desc_conf": prediction.descriptor_confidence,
        }
        for name, output in outputs.items():
            expected = golden[f"{orientation}_view{view}_{name}"]
            assert np.linalg.norm(output.numpy() - expected) < 1e-4 * np.linalg.norm(expected), name
            assert np.abs(output.numpy() - expected).max() < 1e-4 * np.abs(expected).max(), name


def test_the_official_checkpoints_names_and_shapes_are_those_of_the_full_size(shared):
    official = json.loads((shared / "golden" / "mast3r_vitl_state_dict.json").read_text())
    names = shapes_of(Mast3r)
    assert len(official) == 1017
    stand_ins = {name: torch.empty(shape, device="meta") for name, shape in official.items()}
    path = Path("official.pth")
    check_names_and_shapes(stand_ins, names, path, "MASt3R")
    lacking = dict(stand_ins)
    del lacking["enc_blocks.7.attn.qkv.bias"]
    with pytest.raises(ValueError, match=r"lacks enc_blocks\.7\.attn\.qkv\.bias"):
        check_names_and_shapes(lacking, names, path, "MASt3R")
    with pytest.raises(ValueError, match="has enc_blocks.99.bias, which does not belong"):
        check_names_and_shapes(
            stand_ins | {"enc_blocks.99.bias": torch.zeros(1)}, names, Path("official.pth"), "MASt3R"
        )
    with pytest.raises(ValueError, match=r"mask_token of shape \(2,\) instead of \(1, 1, 768\)"):
        check_names_and_shapes(stand_ins | {"mask_token": torch.zeros(2)}, names, path, "MASt3R")


def test_both_layouts_of_the_file_are_read(tmp_path, smallest):
    from safetensors.torch import save_file

    official, safe = tmp_path / "official.pth", tmp_path / "safe.safetensors"
    torch.save({"args": argparse.Namespace(model="AsymmetricMASt3R(...)"), "model": smallest, "epoch": 3}, official)
    save_file({name: tensor.clone() for name, tensor in smallest.items()}, safe)
    image = torch.rand(3, 32, 48, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.no_grad():
        tokens = [load_network(path, SMALLEST).encode(image).tokens for path in (official, safe)]
    torch.testing.assert_close(tokens[0], tokens[1])
    assert tokens[0].shape == (6, 32)


class _Malicious:
    def __init__(self, canary: Path) -> None:
        self._canary = canary

    def __reduce__(self):
        return os.mkdir, (str(self._canary),)


@pytest.mark.parametrize("zipped", [True, False])
def test_a_checkpoint_with_code_runs_nothing(tmp_path, smallest, zipped):
    canary, path = tmp_path / "canary", tmp_path / "bad.pth"
    torch.save({"model": smallest, "args": _Malicious(canary)}, path, _use_new_zipfile_serialization=zipped)
    with pytest.raises(ValueError, match="it wants to run (posix|nt).mkdir"):
        load_network(path, SMALLEST)
    assert not canary.exists()
    pickle.loads(pickle.dumps(_Malicious(canary)))  # it would have run
    assert canary.exists()


def test_damaged_and_foreign_files_are_named(tmp_path, smallest):
    whole, cut, text, foreign = (tmp_path / name for name in ("whole.pth", "cut.pth", "text.pth", "foreign.pth"))
    torch.save(smallest, whole)
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    text.write_text("<html>404</html>")
    torch.save({"model": {"weight": torch.zeros(1)}}, foreign)
    for path, complaint in (
        (cut, "damaged"),
        (text, "was not loaded|damaged"),
        (foreign, "not the checkpoint of MASt3R"),
    ):
        with pytest.raises(ValueError, match=complaint):
            load_network(path, SMALLEST)
    torch.save({"model": [1, 2]}, foreign)
    with pytest.raises(ValueError, match="dict of tensors"):
        load_network(foreign, SMALLEST)
    (tmp_path / "cut.safetensors").write_bytes(b"\x10\0\0\0")
    with pytest.raises(ValueError, match="safetensors"):
        load_network(tmp_path / "cut.safetensors", SMALLEST)
    with pytest.raises(FileNotFoundError):
        load_network(tmp_path / "absent.pth", SMALLEST)


def test_attention_with_rotary_positions_sees_only_distances():
    """The product of two turned vectors depends on where they are relative to each other, not on where they are."""
    positions = grid_positions(4, 4)
    query, key = torch.randn(2, 1, 8, generator=torch.Generator().manual_seed(0)).double()

    def product(at_query: int, at_key: int) -> float:
        rotary = Rotary.create_from_positions(positions[[at_query, at_key]], 8)
        turned_query, turned_key = rotary.rotate(torch.stack([query[0], key[0]]))
        return float(turned_query @ turned_key)

    assert product(0, 5) == pytest.approx(product(10, 15), rel=1e-5)
    assert product(0, 5) != pytest.approx(product(0, 6), rel=1e-3)


def test_images_must_fit_the_patches(smallest, tmp_path):
    torch.save(smallest, tmp_path / "weights.pth")
    with pytest.raises(ValueError, match="multiples of 16"):
        load_network(tmp_path / "weights.pth", SMALLEST).encode(torch.zeros(3, 30, 48))
