"""The network against the released implementation's tensors, and its own contract."""

import json

import pytest
import torch
from networks import TINY
from safetensors.torch import load_file

from gsasr.errors import RequestError
from gsasr.model import GSASR, PRESETS, activate, load_model
from gsasr.model.attention import (
    ScaleAttention,
    WindowAttention,
    relative_position_index,
    turned,
)
from gsasr.model.encoders.swinir import shift_mask
from gsasr.prediction import predict
from gsasr.rasterize import reference
from gsasr.view import View

FAMILIES = ("edsr_paper", "edsr_enhanced", "rdn_paper", "swinir_paper", "hatl_ultra")


@pytest.fixture(params=FAMILIES)
def released(request, golden):
    """A tiny network of each family and what the released code makes of its input."""
    path = golden / f"{request.param}.safetensors"
    return load_model(path), load_file(path)


@pytest.fixture(scope="module")
def paper_model(golden):
    return load_model(golden / "edsr_paper.safetensors")


@pytest.mark.parametrize("gradients", [False, True])  # attention has a way of its own for each
def test_features_and_raw_gaussians_equal_those_of_the_released_code(released, gradients):
    model, tensors = released
    with torch.set_grad_enabled(gradients):
        features = model.encode(tensors["io.lr"])
        raw = model.decode(tensors["io.features"], tensors["io.scale"])
    torch.testing.assert_close(features, tensors["io.features"], atol=1e-5, rtol=0)
    torch.testing.assert_close(raw, tensors["io.raw"], atol=1e-5, rtol=0)


def test_hyper_parameters_are_deduced_from_the_tensors(paper_model):
    decoder = paper_model.config.decoder
    assert paper_model.config.encoder.channels == 16
    assert paper_model.config.encoder.blocks == 2
    assert (decoder.channels, decoder.heads, decoder.window, decoder.seeds) == (24, 6, 4, 4)
    assert (decoder.cross_blocks, decoder.cross_layers) == (1, 2)
    assert (decoder.self_blocks, decoder.self_layers) == (2, 2)
    assert decoder.shuffle == (2, 2)
    assert decoder.gaussians_per_pixel == 16


MANIFESTS = {
    "edsr-baseline": "edsr_paper",
    "edsr-paper": "edsr_paper",
    "rdn-paper": "rdn_paper",
    "swinir-paper": "swinir_paper",
    "edsr-div2k": "edsr_enhanced",
    "edsr-df2k": "edsr_enhanced",
    "rdn-div2k": "rdn_enhanced",
    "rdn-df2k": "rdn_enhanced",
    "swinir-div2k": "swinir_enhanced",
    "swinir-df2k": "swinir_enhanced",
    "hatl-sa1b": "hatl_ultra",
}


@pytest.mark.parametrize("preset", sorted(PRESETS.keys() - {"lite"}))
def test_full_size_presets_match_the_released_manifests_key_for_key(golden, preset):
    manifest = json.loads((golden / f"manifest_{MANIFESTS[preset]}.json").read_text())
    with torch.device("meta"):
        model = GSASR(PRESETS[preset])
    for part in ("encoder", "decoder"):
        ours = model.get_submodule(part).state_dict()
        assert {k: list(v.shape) for k, v in ours.items()} == manifest[part]
        parameters = sum(p.numel() for p in model.get_submodule(part).parameters())
        assert parameters == manifest["parameters"][part]
    buffers = {k: str(v.dtype).removeprefix("torch.") for k, v in model.named_buffers()}
    assert buffers == manifest["buffers"]
    assert model.multiple == manifest["input_multiple"]
    assert model.config.decoder.gaussians_per_pixel == manifest["gaussians_per_lr_pixel"]


@pytest.mark.parametrize(("case", "scale"), [(1, 4), (5, 1)])
@pytest.mark.parametrize("source", ["edsr_paper", "synthetic"])
def test_activated_gaussians_render_to_the_released_image(golden, source, case, scale):
    cases = load_file(golden / "raster.safetensors")
    if source == "synthetic":
        raw = cases["synthetic.raw"].double()
    else:
        raw = load_file(golden / f"{source}.safetensors")["io.raw"][0].double()
    image = cases[f"{source}.case{case}.image"].permute(1, 2, 0)
    field = activate(raw, (image.shape[0] // scale, image.shape[1] // scale))
    rendered = reference.render(field, View.at_scale(field.size, scale))
    torch.testing.assert_close(rendered, image, atol=1e-4, rtol=0)


def test_activation_gives_the_released_means_and_spreads(golden):
    cases = load_file(golden / "raster.safetensors")
    raw = load_file(golden / "edsr_paper.safetensors")["io.raw"][0].double()
    field = activate(raw, (12, 16))
    for name, expected in (("mean", "lr.mean"), ("std", "lr.std"), ("rho", "rho")):
        value = cases[f"edsr_paper.{expected}"]
        torch.testing.assert_close(getattr(field, name), value, atol=1e-12, rtol=0)


def test_scale_attention_equals_full_attention_over_equal_keys():
    torch.manual_seed(0)
    ours, full = ScaleAttention(8), torch.nn.MultiheadAttention(8, 2, batch_first=True)
    full.load_state_dict(ours.state_dict())
    embedding, queries = torch.randn(3, 8), torch.randn(3, 5, 8)
    keys = embedding[:, None].expand(3, 7, 8)
    expected, _ = full(queries, keys, keys)
    torch.testing.assert_close(ours(embedding)[:, 0].expand(3, 5, 8), expected)


def test_relative_positions_number_offsets_row_by_row():
    index = relative_position_index(3, 3).view(3, 3, 3, 3)
    # query (2, 0) and key (0, 1): offsets +2 and -1, shifted by 2, on a 5x5 table
    assert index[2, 0, 0, 1] == 4 * 5 + 1
    assert relative_position_index(4, 2).max() < 7 * 7


def test_scale_is_conditioned_per_item_of_the_batch(tiny_model):
    lr = torch.rand(1, 3, 8, 8).expand(2, 3, 8, 8)
    both = tiny_model(lr, torch.tensor([1.5, 4.0]))
    torch.testing.assert_close(both[1:], tiny_model(lr[:1], 4.0))
    assert not torch.allclose(both[0], both[1])


def test_features_of_the_wrong_size_and_bad_scales_are_refused(tiny_model):
    with pytest.raises(RequestError, match="multiples of 4"):
        tiny_model.decode(torch.rand(1, 8, 6, 8), 2.0)
    with pytest.raises(RequestError, match="above 0"):
        tiny_model.decode(torch.rand(1, 8, 8, 8), 0.0)


@pytest.mark.parametrize("family", TINY)
def test_every_weight_that_matters_gets_a_gradient_in_every_family(family):
    torch.manual_seed(0)
    model = GSASR(TINY[family])
    raw = model(torch.rand(1, 3, 2 * model.multiple, model.multiple), 2.0)
    (raw * torch.randn_like(raw)).sum().backward()
    for name, parameter in model.named_parameters():
        # The norm before the scale attention only feeds its query, which never matters.
        unused = ".norm1." if "window_crossattn" in name else ".norm3."
        if name.startswith("decoder") and unused in name:
            assert parameter.grad is None
        else:
            assert parameter.grad is not None and bool(parameter.grad.abs().sum() > 0), name


@pytest.mark.parametrize("family", TINY)
def test_networks_start_with_features_of_the_size_of_the_picture_and_grey_gaussians(family):
    torch.manual_seed(0)
    model = GSASR(TINY[family]).eval()
    lr = torch.rand(1, 3, 2 * model.multiple, 2 * model.multiple)
    with torch.inference_mode():
        features = model.encode(lr)
        raw = model.decode(features, 3.0)[0]
    assert 0.05 < features.std() < 5
    pixels = lr.shape[2] * lr.shape[3]
    field = activate(raw, lr.shape[2:])
    assert len(field) == pixels * model.config.decoder.gaussians_per_pixel
    assert 0.3 < field.color.mean() < 0.7
    assert 0.4 < field.opacity.sum() / pixels < 1.2


@pytest.mark.parametrize("position", ["bias", "rotary"])
def test_attention_can_start_by_looking_at_its_own_position(position):
    torch.manual_seed(0)
    attention = WindowAttention(64, 2, 8, 8, position)
    for layer in (attention.qhead, attention.khead, attention.vhead, attention.proj):
        torch.nn.init.zeros_(layer.bias)
    for layer in (attention.qhead, attention.khead):
        torch.nn.init.zeros_(layer.weight)
    for layer in (attention.vhead, attention.proj):
        torch.nn.init.eye_(layer.weight)
    attention.look_at_own_position()
    with torch.inference_mode():
        # Values that number the tokens, so that what comes out are the weights of attention.
        weights = attention(torch.zeros(1, 64, 64), torch.eye(64)[None])[0]
    assert bool((weights.argmax(dim=1) == torch.arange(64)).all())
    assert weights.diagonal().min() > 4 / 64


def test_rotary_attention_depends_on_offsets_only():
    torch.manual_seed(0)
    x = torch.randn(1, 1, 1, 8).expand(1, 1, 16, 8)  # the same token on a 4x4 grid
    attention = WindowAttention(8, 1, 4, 4, "rotary")
    angles = attention._angles()
    logits = (turned(x, angles) @ turned(x, angles).transpose(-2, -1))[0, 0].view(4, 4, 4, 4)
    # one to the right and one down, from (0, 0) and from (2, 1)
    torch.testing.assert_close(logits[0, 0, 1, 1], logits[2, 1, 3, 2])
    assert not torch.allclose(logits[0, 0, 1, 1], logits[0, 0, 1, 2])


def test_shifted_windows_do_not_mix_opposite_edges_of_the_picture():
    mask = shift_mask(8, 8, window=4, shift=2)
    assert mask.shape == (4, 16, 16)
    assert bool((mask[0] == 0).all())  # a window of the inside
    across = mask[1].view(4, 4, 4, 4)  # its right half has wrapped around
    assert bool((across[:, :2, :, :2] == 0).all() and (across[:, :2, :, 2:] == -100).all())


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 2)])
def test_every_family_predicts_pictures_smaller_than_its_padding(released, size):
    model, _ = released
    photo = torch.rand(*size, 3).numpy()
    field = predict(model, photo, 2.0).validate()
    assert field.size == size
    assert len(field) >= 16 * size[0] * size[1]


def test_pictures_that_do_not_fit_the_windows_are_refused_by_the_encoder(released):
    model, _ = released
    with pytest.raises(RequestError, match="multiples of 4"):
        model.encode(torch.rand(1, 3, 8, 6))
