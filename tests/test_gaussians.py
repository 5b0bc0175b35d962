"""The data type and its file."""

import pytest
import torch
from fields import random_field
from safetensors.torch import save_file

from gsasr.errors import FieldError
from gsasr.gaussians import Gaussians


def test_a_saved_field_comes_back_unchanged(tmp_path):
    field = random_field(100, (7, 5))
    field = Gaussians(**field.tensors(), size=(7, 5), model="lite", scale=4.0, source="cat.png")
    field.save(tmp_path / "field.safetensors")
    again = Gaussians.load(tmp_path / "field.safetensors")
    assert (again.size, again.model, again.scale, again.source) == ((7, 5), "lite", 4.0, "cat.png")
    for name, tensor in field.tensors().items():
        assert torch.equal(getattr(again, name), tensor)


def test_an_empty_field_can_be_saved(tmp_path):
    random_field(0, (7, 5)).save(tmp_path / "none.safetensors")
    assert len(Gaussians.load(tmp_path / "none.safetensors")) == 0


def test_selecting_and_concatenating_keep_rows_together():
    field = random_field(10, (4, 4))
    joined = Gaussians.concatenate([field[:3], field[field.opacity < 2][3:]])
    for name, tensor in field.tensors().items():
        assert torch.equal(getattr(joined, name), tensor)


def test_shapes_are_checked():
    field = random_field(3, (4, 4))
    with pytest.raises(FieldError, match=r"std must have shape \(3, 2\), but has \(3,\)"):
        Gaussians(**field.tensors() | {"std": field.rho}, size=(4, 4))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("mean", float("nan"), "mean holds values that are not finite"),
        ("std", 0.0, "std must be above 0"),
        ("rho", 1.0, "rho must lie strictly between"),
        ("opacity", 1.5, "opacity must lie in"),
        ("color", -0.1, "color must lie in"),
    ],
)
def test_a_file_with_impossible_values_is_refused(tmp_path, name, value, words):
    field = random_field(3, (4, 4))
    broken = field.tensors()[name].clone()
    broken[1] = value
    Gaussians(**field.tensors() | {name: broken}, size=(4, 4)).save(tmp_path / "f.safetensors")
    with pytest.raises(FieldError, match=words):
        Gaussians.load(tmp_path / "f.safetensors")


def test_files_that_hold_no_field_are_refused(tmp_path):
    other, cut = tmp_path / "other.safetensors", tmp_path / "cut.safetensors"
    save_file({"weight": torch.zeros(3)}, other)
    random_field(50, (4, 4)).save(cut)
    cut.write_bytes(cut.read_bytes()[:300])
    (tmp_path / "empty.safetensors").write_bytes(b"")
    for path, words in (
        (other, "holds no Gaussians"),
        (cut, "damaged"),
        (tmp_path / "empty.safetensors", "damaged"),
        (tmp_path / "missing.safetensors", "does not exist"),
        (tmp_path, "is a folder"),
    ):
        with pytest.raises(FieldError, match=words):
            Gaussians.load(path)


def test_a_failed_save_leaves_nothing_behind(tmp_path):
    with pytest.raises(FieldError, match="does not exist"):
        random_field(3, (4, 4)).save(tmp_path / "no" / "field.safetensors")
    with pytest.raises(FieldError, match="is a folder"):
        random_field(3, (4, 4)).save(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_file_with_an_impossible_size_is_refused(tmp_path):
    for size in ("5", "[Infinity, 2]", "[0, 0]", "[-1, 4]", "{}"):
        field = random_field(3, (4, 4))
        metadata = {"format": "gsasr-gaussians", "size": size}
        save_file(field.tensors(), tmp_path / "f.safetensors", metadata)
        with pytest.raises(FieldError):
            Gaussians.load(tmp_path / "f.safetensors")


def test_writing_goes_through_a_link_and_keeps_the_usual_permissions(tmp_path):
    (tmp_path / "plain").touch()
    (tmp_path / "link.safetensors").symlink_to(tmp_path / "real.safetensors")
    random_field(3, (4, 4)).save(tmp_path / "link.safetensors")
    assert (tmp_path / "link.safetensors").is_symlink()
    written = (tmp_path / "real.safetensors").stat()
    assert written.st_mode == (tmp_path / "plain").stat().st_mode and written.st_size > 0
