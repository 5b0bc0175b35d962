"""The network against the released implementation's tensors, and its own contract."""

import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from gsasr.errors import CheckpointError, RequestError
from gsasr.model import GSASR, PRESETS, activate, load_model, save_model
from gsasr.model.attention import ScaleAttention, relative_position_index
from gsasr.model.checkpoint import build
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


def test_features_equal_those_of_the_released_code(released):
    model, tensors = released
    with torch.inference_mode():
        features = model.encode(tensors["io.lr"])
    torch.testing.assert_close(features, tensors["io.features"], atol=1e-5, rtol=0)


def test_raw_gaussians_equal_those_of_the_released_code(released):
    model, tensors = released
    with torch.inference_mode():
        raw = model.decode(tensors["io.features"], tensors["io.scale"])
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


def test_every_weight_that_matters_gets_a_gradient(tiny_model):
    tiny_model(torch.rand(1, 3, 8, 8), 2.0).square().mean().backward()
    # The norm before the scale attention only feeds its query, which never matters.
    dead = (".norm1.", ".norm3.")
    for name, parameter in tiny_model.named_parameters():
        scale_norm = dead[0] if "crossattn" in name else dead[1]
        if scale_norm in name:
            assert parameter.grad is None
        else:
            assert parameter.grad is not None and bool(parameter.grad.abs().sum() > 0), name


def test_a_saved_network_loads_with_the_same_output(tiny_model, tmp_path):
    save_model(tiny_model, tmp_path / "tiny.safetensors")
    loaded = load_model(tmp_path / "tiny.safetensors")
    lr = torch.rand(1, 3, 8, 12)
    assert loaded.config == tiny_model.config
    torch.testing.assert_close(loaded(lr, 3.0), tiny_model(lr, 3.0), atol=0, rtol=0)


def test_the_shipped_model_loads_by_name():
    model = load_model("lite")
    assert model.name == "lite"
    assert model.config == PRESETS["lite"]


def test_checkpoints_that_do_not_fit_are_refused_with_the_reason(tiny_model, tmp_path):
    state = {k: v.clone() for k, v in tiny_model.state_dict().items()}
    path = tmp_path / "model.safetensors"

    def message(changed: dict) -> str:
        save_file(changed, path)
        with pytest.raises(CheckpointError) as error:
            load_model(path)
        return str(error.value)

    key = "decoder.mlp_block_rho.4.bias"
    assert f"lacks {key}" in message({k: v for k, v in state.items() if k != key})
    assert "unknown decoder.more" in message(state | {"decoder.more": torch.zeros(1)})
    assert f"another shape of {key}" in message(state | {key: torch.zeros(7)})
    assert "not finite" in message(state | {key: torch.tensor([float("nan")])})
    assert "no GSASR network" in message({"weight": torch.zeros(3)})


def test_truncated_missing_and_unknown_models_are_refused(tiny_model, tmp_path):
    path = tmp_path / "model.safetensors"
    save_model(tiny_model, path)
    path.write_bytes(path.read_bytes()[:1000])
    for name, words in ((path, "damaged"), ("nonsense", "no model"), ("edsr-baseline", "shipped")):
        with pytest.raises(CheckpointError, match=words):
            load_model(name)


def test_building_leaves_the_given_tensors_alone(tiny_model):
    encoder = {k: v.clone() for k, v in tiny_model.encoder.state_dict().items()}
    decoder = {k: v.clone() for k, v in tiny_model.decoder.state_dict().items()}
    before = set(encoder), set(decoder)
    built = build(encoder, decoder, "copy", "memory")
    assert (set(encoder), set(decoder)) == before
    assert built.config == replace(tiny_model.config)
