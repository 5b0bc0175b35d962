"""Files of networks: which are understood, which are refused, and how names become files."""

import json
import os
import shutil

import huggingface_hub
import pytest
import torch
from networks import TINY
from safetensors import safe_open
from safetensors.torch import save_file

from gsasr.cli import main
from gsasr.describe import describe
from gsasr.errors import CheckpointError
from gsasr.model import GSASR, PRESETS, hub, load_model, save_model
from gsasr.model.checkpoint import build


@pytest.fixture
def network():
    """An untrained network of a family that has everything: masks, rotary positions, buffers."""
    return fresh("HAT enhanced")


def fresh(family: str) -> GSASR:
    torch.manual_seed(0)
    return GSASR(TINY[family], family).eval()


def halves(network: GSASR) -> tuple[dict, dict]:
    return network.encoder.state_dict(), network.decoder.state_dict()


def save_pair(network: GSASR, folder, names=("encoder.pth", "decoder.pth"), key="params_ema"):
    """The two files that the authors publish of a network."""
    folder.mkdir(exist_ok=True)
    for name, state in zip(names, halves(network), strict=True):
        torch.save({key: state}, folder / name)


def same(first: GSASR, second: GSASR) -> bool:
    lr = torch.rand(1, 3, first.multiple, 2 * first.multiple)
    with torch.inference_mode():
        return first.config == second.config and torch.equal(first(lr, 3.0), second(lr, 3.0))


def refusal(model) -> str:
    with pytest.raises(CheckpointError) as error:
        load_model(model)
    message = str(error.value)
    assert message.endswith(".") and "\n" not in message
    return message


@pytest.mark.parametrize("family", TINY)
def test_every_hyper_parameter_is_deduced_from_the_tensors_alone(family, tmp_path):
    network = fresh(family)
    save_file(network.state_dict(), tmp_path / "bare.safetensors")  # without any metadata
    assert same(load_model(tmp_path / "bare.safetensors"), network)


def test_a_saved_network_loads_with_the_same_output_and_its_configuration_inside(network, tmp_path):
    save_model(network, tmp_path / "tiny.safetensors")
    assert same(load_model(tmp_path / "tiny.safetensors"), network)
    with safe_open(tmp_path / "tiny.safetensors", "pt") as file:
        assert file.metadata()["family"] == "HAT with the enhanced decoder"
        assert json.loads(file.metadata()["config"])["encoder"]["reach"] == 6


def test_a_window_that_no_tensor_tells_is_read_from_the_configuration(tmp_path):
    from dataclasses import replace

    config = TINY["EDSR enhanced"]
    decoder = replace(config.decoder, window=4, seeds=8)
    network = GSASR(replace(config, decoder=decoder), "fine").eval()
    save_model(network, tmp_path / "fine.safetensors")
    assert same(load_model(tmp_path / "fine.safetensors"), network)


def test_the_shipped_model_loads_by_name():
    model = load_model("lite")
    assert model.name == "lite"
    assert model.config == PRESETS["lite"]


def test_a_pair_of_official_files_loads_by_folder_by_either_file_and_by_both(network, tmp_path):
    folder = tmp_path / "HATL"
    save_pair(network, folder)
    for given in (folder, folder / "encoder.pth", folder / "decoder.pth"):
        loaded = load_model(given)
        assert same(loaded, network) and loaded.name == "HATL"
    (tmp_path / "elsewhere").mkdir()
    moved = shutil.move(folder / "decoder.pth", tmp_path / "elsewhere" / "d.pth")
    assert same(load_model(f"{moved},{folder / 'encoder.pth'}"), network)


def test_files_of_a_training_run_load_and_the_furthest_trained_are_taken(network, tmp_path):
    for key, rest in (("params", "_500"), ("params_ema", "_10000")):
        save_pair(network, tmp_path / "run", (f"net_g{rest}.pth", f"net_fea2gs{rest}.pth"), key)
    other = fresh("EDSR paper")
    save_pair(other, tmp_path / "run", ("net_g_500.pth", "net_fea2gs_500.pth"), "params")
    assert same(load_model(tmp_path / "run"), network)
    assert same(load_model(tmp_path / "run" / "net_fea2gs_500.pth"), other)
    save_pair(other, tmp_path / "paper", ("net_g.pth", "net_fea2gs.pth"))
    assert same(load_model(tmp_path / "paper"), other)


def test_averaged_weights_are_preferred(network, tmp_path):
    for name, state in zip(("encoder.pth", "decoder.pth"), halves(network), strict=True):
        torch.save({"params": {}, "params_ema": state}, tmp_path / name)
    assert same(load_model(tmp_path), network)


def test_a_hostile_pickle_is_refused_and_none_of_its_code_runs(network, tmp_path):
    class Hostile:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "it ran"),)

    save_pair(network, tmp_path)
    for content in ({"params_ema": Hostile()}, Hostile()):
        torch.save(content, tmp_path / "encoder.pth")
        assert "source that you trust" in refusal(tmp_path)
        torch.save(content, tmp_path / "encoder.pth", _use_new_zipfile_serialization=False)
        assert "source that you trust" in refusal(tmp_path)
    assert not (tmp_path / "it ran").exists()


def test_a_tensor_that_claims_to_be_larger_than_its_file_is_refused(network, tmp_path):
    save_pair(network, tmp_path)
    vast = torch.zeros(1).as_strided((1 << 20, 1 << 20), (0, 0))
    torch.save({"params_ema": {"conv_first.weight": vast}}, tmp_path / "encoder.pth")
    assert "holds no weights" in refusal(tmp_path)


@pytest.mark.parametrize("length", [0, 100, 5000])
def test_truncated_files_are_refused(network, tmp_path, length):
    save_pair(network, tmp_path)
    save_model(network, tmp_path / "model.safetensors")
    for name in ("decoder.pth", "model.safetensors"):
        path = tmp_path / name
        path.write_bytes(path.read_bytes()[:length])
        assert f"{path} is damaged" in refusal(path)


def test_a_pair_that_is_none_is_refused(network, tmp_path):
    assert "lacks a pair" in refusal(tmp_path)
    assert "does not exist" in refusal(tmp_path / "encoder.pth")
    save_pair(network, tmp_path)
    first, second = tmp_path / "encoder.pth", tmp_path / "other.pth"
    shutil.copy(first, second)
    assert "both hold the encoder" in refusal(f"{first},{second}")
    assert "holds the encoder alone" in refusal(second)
    (tmp_path / "decoder.pth").unlink()
    assert "beside it as decoder.pth" in refusal(first)
    torch.save([1, 2], first)
    assert "holds no weights" in refusal(first)
    save_pair(network, tmp_path)
    torch.save({"params_ema": fresh("EDSR paper").encoder.state_dict()}, first)
    assert "another shape of decoder.img_feat_proj.0.weight" in refusal(tmp_path)


@pytest.mark.parametrize("family", TINY)
def test_keys_that_do_not_fit_are_named_with_the_family_that_the_file_looks_like(family, tmp_path):
    network = fresh(family)
    state = {k: v.clone() for k, v in network.state_dict().items()}
    path = tmp_path / "model.safetensors"

    def message(changed: dict) -> str:
        save_file(changed, path)
        return refusal(path)

    key = "decoder.mlp_block_rho.4.bias"
    without = message({k: v for k, v in state.items() if k != key})
    assert f"looks like {network.config}, but lacks {key};" in without
    assert "unknown decoder.more" in message(state | {"decoder.more": torch.zeros(1)})
    assert f"another shape of {key}" in message(state | {key: torch.zeros(7)})
    assert "not finite" in message(state | {key: torch.tensor([float("nan")])})
    needed = "decoder.gs_embedding"
    assert f"lacks {needed}" in message({k: v for k, v in state.items() if k != needed})
    encoder = {k: v for k, v in state.items() if k.startswith("encoder")}
    assert "no GSASR network" in message(encoder)
    assert "no GSASR network" in message({"weight": torch.zeros(3)})


def test_unknown_names_are_refused_with_those_that_are_known():
    assert "hatl-sa1b" in refusal("nonsense")
    assert "shipped" in refusal("edsr-baseline")


def test_building_copies_the_given_tensors(network):
    state = network.state_dict()
    built = build(state, "copy", "memory")
    with torch.no_grad():
        built.decoder.gs_embedding.zero_()
    assert not bool((state["decoder.gs_embedding"] == 0).any())


def test_converting_writes_one_file_that_loads_alike_and_half_of_it_on_request(network, tmp_path):
    save_pair(network, tmp_path / "official")
    whole, half = tmp_path / "whole.safetensors", tmp_path / "half.safetensors"
    assert main(["convert", str(tmp_path / "official/encoder.pth"), "-o", str(whole)]) == 0
    assert main(["convert", str(whole), "-o", str(half), "--half"]) == 0
    assert same(load_model(whole), network)
    assert half.stat().st_size < 0.75 * whole.stat().st_size  # keys take room in one this small
    lr = torch.rand(1, 3, 8, 8)
    with torch.inference_mode():
        difference = load_model(half)(lr, 3.0) - network(lr, 3.0)
    assert 0 < difference.abs().max() < 1e-2
    assert main(["convert", str(whole), "-o", str(tmp_path / "wrong.pth")]) == 2


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("edsr_paper", ["EDSR with the paper's decoder", "16 channels, 2 blocks", "window 4"]),
        ("edsr_enhanced", ["EDSR with the enhanced decoder", "24 channels, 3 heads"]),
        ("rdn_paper", ["RDN with the paper's decoder", "3 blocks of 3 layers, growth 8"]),
        ("swinir_paper", ["SwinIR with the paper's decoder", "4 blocks in 2 groups"]),
        ("hatl_ultra", ["HAT with the enhanced decoder", "windows 4 and 6", "2x3 injection"]),
    ],
)
def test_info_names_the_family_and_its_sizes(golden, name, words, tmp_path):
    rows = describe(golden / f"{name}.safetensors")
    assert rows["Gaussians per pixel"] == "16"
    for word in words:
        assert word in " ".join(rows.values())
    save_pair(load_model(golden / f"{name}.safetensors"), tmp_path)
    assert describe(tmp_path) == describe(tmp_path / "decoder.pth") == rows


class Hub:
    """Stands for the authors' repository and the cache; counts what is downloaded."""

    def __init__(self, folder):
        self.folder, self.cached, self.downloads = folder, set(), []

    def metadata(self, url, timeout):
        assert url.startswith("https://huggingface.co/mutou0308/GSASR/resolve/main/")

    def download(self, repository, file, local_files_only=False, force_download=False):
        if local_files_only and file not in self.cached:
            raise huggingface_hub.errors.LocalEntryNotFoundError(file)
        if not local_files_only and (force_download or file not in self.cached):
            self.downloads.append(file)
            self.cached.add(file)
            shutil.copytree(self.folder / "published", self.folder / "cache", dirs_exist_ok=True)
        return str(self.folder / "cache" / file.split("/")[-1])


@pytest.fixture
def published(network, tmp_path, monkeypatch):
    """A repository that holds a tiny network under the name swinir-df2k."""
    save_pair(network, tmp_path / "published")
    monkeypatch.setitem(PRESETS, "swinir-df2k", network.config)
    stand_in = Hub(tmp_path)
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", stand_in.download)
    monkeypatch.setattr(huggingface_hub, "get_hf_file_metadata", stand_in.metadata)
    return stand_in


def test_a_published_model_is_downloaded_once(published, network):
    files = [f"GSASR_enhenced_ultra/SWIN_DF2K/{part}.pth" for part in ("encoder", "decoder")]
    for _ in range(2):
        model = load_model("swinir-df2k")
        assert same(model, network) and model.name == "swinir-df2k"
        assert published.downloads == files


def test_a_damaged_file_in_the_cache_is_downloaded_anew(published, network, tmp_path):
    load_model("swinir-df2k")
    whole = (tmp_path / "cache" / "decoder.pth").read_bytes()
    (tmp_path / "cache" / "decoder.pth").write_bytes(whole[:1000])
    assert same(load_model("swinir-df2k"), network)
    assert (tmp_path / "cache" / "decoder.pth").read_bytes() == whole


def test_what_is_missing_in_a_half_filled_cache_is_downloaded(published, network):
    load_model("swinir-df2k")
    published.cached.remove("GSASR_enhenced_ultra/SWIN_DF2K/decoder.pth")
    published.downloads.clear()
    assert same(load_model("swinir-df2k"), network)
    assert published.downloads == ["GSASR_enhenced_ultra/SWIN_DF2K/decoder.pth"]


def test_a_published_file_of_another_family_is_refused_with_what_it_looks_like(published):
    save_pair(fresh("RDN paper"), published.folder / "published")
    message = refusal("swinir-df2k")
    assert "looks like RDN with the paper's decoder" in message


def test_published_presets_are_those_with_a_folder_in_the_manifests(golden):
    manifests = [json.loads(path.read_text()) for path in golden.glob("manifest_*.json")]
    assert sorted(hub.FOLDERS.values()) == sorted(f for m in manifests for f in m["folders"])
    assert hub.FOLDERS.keys() <= PRESETS.keys()


def test_without_a_network_one_sentence_names_the_files_and_the_flag(monkeypatch, tmp_path, capsys):
    nowhere = "http://127.0.0.1:9/nothing-listens-here"
    monkeypatch.setattr(huggingface_hub, "hf_hub_url", lambda *_: nowhere)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    for name, folder in hub.FOLDERS.items():
        message = refusal(name)
        assert "encoder.pth and decoder.pth" in message and "--model FOLDER" in message
        assert f"https://huggingface.co/mutou0308/GSASR/tree/main/{folder} " in message
    picture = tmp_path / "in.png"
    shutil.copy(os.path.join(os.path.dirname(__file__), "../assets/images/cat.png"), picture)
    out = tmp_path / "out.png"
    command = ["upscale", str(picture), "-o", str(out), "--scale", "2", "--model", "hatl-sa1b"]
    assert main(command) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and captured.err.startswith("gsasr: Cannot download")
    assert not out.exists()


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("GatedRepoError", "gives no access"),
        ("RepositoryNotFoundError", "gives no access"),
        ("RemoteEntryNotFoundError", "no such file"),
        ("OfflineModeIsEnabled", "HF_HUB_OFFLINE is set"),
    ],
)
def test_a_repository_that_refuses_gives_the_reason(published, monkeypatch, kind, words):
    error = getattr(huggingface_hub.errors, kind)

    def refuse(url, timeout):
        raise error.__new__(error)

    monkeypatch.setattr(huggingface_hub, "get_hf_file_metadata", refuse)
    assert words in refusal("swinir-df2k")
