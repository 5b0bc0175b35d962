"""What training is fed with: crops of pictures, in batches, whoever prepares them."""

import os

import numpy as np
import pytest
import torch
from PIL import Image
from training import QUICK, write_pictures

from gsasr.errors import DataError
from gsasr.imresize import downscale as matlab_downscale
from gsasr.training.config import Execution
from gsasr.training.data import CropSampler, downscale, find_pictures, validation_samples
from gsasr.training.loader import Batch, load_batches
from gsasr.training.parallel import Group

CPU = torch.device("cpu")


@pytest.fixture
def pictures(tmp_path, images):
    """A folder tree of three pictures of at least 192 pixels a side."""
    folder = tmp_path / "pictures"
    (folder / "more").mkdir(parents=True)
    for name, path in (("a.png", "astronaut"), ("more/b.jpg", "cat"), ("c.png", "chart")):
        Image.open(images / f"{path}.png").convert("RGB").save(folder / name)
    return folder


def equal(one: Batch, other: Batch) -> bool:
    return (
        one.sizes == other.sizes and torch.equal(one.lr, other.lr) and torch.equal(one.hr, other.hr)
    )


def test_pictures_are_found_in_the_whole_tree_but_hidden_ones(pictures):
    (pictures / "notes.txt").write_text("no picture")
    (pictures / ".half.png").write_bytes(b"left behind by a kill")
    (pictures / "folder.png").mkdir()
    assert [p.name for p in find_pictures(pictures)] == ["a.png", "c.png", "b.jpg"]
    with pytest.raises(DataError, match="no pictures"):
        find_pictures(pictures / "none")


def test_downscaling_is_the_antialiased_bicubic_of_pillow(images):
    picture = Image.open(images / "cat.png").convert("RGB")
    ours = downscale(torch.from_numpy(np.array(picture)), (50, 75)).numpy()
    pillow = np.asarray(picture.resize((75, 50), Image.Resampling.BICUBIC))
    difference = np.abs(ours.astype(int) - pillow)  # Pillow rounds between its two passes
    assert ours.dtype == np.uint8 and difference.max() <= 2 and difference.mean() < 0.3


def test_training_and_benchmark_downscaling_differ_by_less_than_a_level(images):
    picture = np.array(Image.open(images / "cat.png").convert("RGB"))[:192, :192]
    one = downscale(torch.from_numpy(picture), (48, 48)).numpy().astype(int)
    assert np.abs(one - matlab_downscale(picture, 4)).mean() < 0.3


def test_a_sample_depends_on_seed_step_and_index_alone(pictures):
    one, other = (CropSampler(pictures, 8, (1.0, 4.0)) for _ in range(2))
    for index in range(3):
        one.sample(0, 0, index)
    a, b = one.sample(7, 5, 2), other.sample(7, 5, 2)
    assert a.scale == b.scale and torch.equal(a.hr, b.hr) and torch.equal(a.lr, b.lr)
    for different in ((8, 5, 2), (7, 6, 2), (7, 5, 3)):
        assert not torch.equal(a.lr, one.sample(*different).lr)


def test_crops_have_the_size_of_their_scale_and_belong_together(pictures):
    sampler = CropSampler(pictures, 16, (1.0, 4.0))
    scales = []
    for index in range(40):
        sample = sampler.sample(0, 0, index)
        assert sample.lr.shape == (16, 16, 3) and sample.lr.dtype == torch.uint8
        assert sample.hr.shape == (round(16 * sample.scale),) * 2 + (3,)
        scales.append(sample.scale)
        again = downscale(sample.hr, (16, 16)).int()
        assert int((again - sample.lr.int()).abs().max()) <= 1
    assert 1 <= min(scales) < 1.5 and 3.5 < max(scales) <= 4


def test_pictures_too_small_or_damaged_are_left_out_and_named_once(pictures):
    (pictures / "broken.png").write_bytes((pictures / "a.png").read_bytes()[:2000])
    (pictures / "text.png").write_text("not a picture")
    Image.new("RGB", (16, 200)).save(pictures / "thin.png")
    sampler = CropSampler(pictures, 8, (1.0, 4.0))
    assert "thin.png" not in [p.name for p in sampler.paths]
    for step in range(60):
        sampler.sample(0, step, 0)
    said = "\n".join(sampler.news)
    assert said.count("text.png") == 1 and said.count("broken.png") == 1
    assert "32x32 pixels: 1 pictures" in said
    with pytest.raises(DataError, match="at least 2000x2000"):
        CropSampler(pictures, 500, (1.0, 4.0))


def test_a_damaged_picture_changes_no_sample_of_the_others(pictures):
    sound = CropSampler(pictures, 8, (1.0, 4.0))
    before = [sound.sample(0, 0, index) for index in range(20)]
    whole = (pictures / "c.png").read_bytes()
    (pictures / "c.png").write_bytes(whole[: len(whole) // 2])
    fresh, again = (CropSampler(pictures, 8, (1.0, 4.0)) for _ in range(2))
    after = [fresh.sample(0, 0, index) for index in range(20)]
    # The order in which samples are asked for does not matter either.
    backwards = [again.sample(0, 0, index) for index in reversed(range(20))][::-1]
    same = [torch.equal(a.hr, b.hr) for a, b in zip(before, after, strict=True)]
    assert 0 < sum(same) < 20
    assert all(torch.equal(a.hr, b.hr) for a, b in zip(after, backwards, strict=True))


def test_decoded_pictures_are_kept_up_to_the_cache_alone(tmp_path):
    folder = write_pictures(tmp_path / "pictures", count=5, side=100)
    bounded = CropSampler(folder, 8, (1.0, 4.0), cache=2 * 100 * 100 * 3)
    free = CropSampler(folder, 8, (1.0, 4.0))
    for index in range(30):
        assert torch.equal(bounded.sample(0, 0, index).hr, free.sample(0, 0, index).hr)
        assert sum(p.numel() for p in bounded._decoded.values()) <= bounded.cache
    assert len(bounded._decoded) == 2 and len(free._decoded) == 5


def test_validation_covers_each_picture_at_each_scale(pictures):
    samples = validation_samples(pictures)
    assert [s.scale for s in samples] == [2, 3, 4] * 3
    assert samples[2].lr.shape == (48, 48, 3) and samples[2].hr.shape == (192, 192, 3)


def test_batches_of_workers_equal_those_made_here_and_are_in_order(tmp_path):
    folder = write_pictures(tmp_path / "pictures")
    (folder / "z.png").write_bytes((folder / "0.png").read_bytes()[:900])
    taken = {}
    for workers in (0, 2):
        sampler = CropSampler(folder, 8, (1.0, 4.0))
        execution = Execution(workers=workers)
        taken[workers] = list(load_batches(sampler, QUICK, range(2, 9), Group(CPU), execution))
    for step, (here, there) in enumerate(zip(taken[0], taken[2], strict=True), start=2):
        expected = Batch.of([sampler.sample(QUICK.seed, step, i) for i in range(QUICK.batch)])
        assert equal(here.batch, there.batch) and equal(here.batch, expected)
    assert any("z.png" in line for loaded in taken[2] for line in loaded.news)


def test_the_shares_of_all_processes_make_up_the_batch(tmp_path):
    sampler = CropSampler(write_pictures(tmp_path / "pictures"), 8, (1.0, 4.0))
    inline = Execution(workers=0)
    (whole,) = load_batches(sampler, QUICK, range(1), Group(CPU), inline)
    halves = [
        next(load_batches(sampler, QUICK, range(1), Group(CPU, rank, 2), inline)).batch
        for rank in range(2)
    ]
    assert torch.equal(whole.batch.lr, torch.cat([half.lr for half in halves]))
    assert torch.equal(whole.batch.hr, torch.cat([half.hr for half in halves]))


def test_a_batch_gives_back_the_samples_it_was_made_of(tmp_path):
    sampler = CropSampler(write_pictures(tmp_path / "pictures"), 8, (1.0, 4.0))
    samples = [sampler.sample(0, 0, index) for index in range(4)]
    batch = Batch.of(samples)
    assert batch.scales.tolist() == pytest.approx([sample.scale for sample in samples])
    for truth, sample in zip(batch.truths(), samples, strict=True):
        assert torch.equal((truth * 255).round().byte(), sample.hr)


def test_data_without_a_single_sound_picture_is_an_error_also_from_a_worker(tmp_path):
    folder = write_pictures(tmp_path / "pictures", count=1)
    whole = (folder / "0.png").read_bytes()
    (folder / "0.png").write_bytes(whole[: len(whole) // 2])
    for workers in (0, 1):
        sampler = CropSampler(folder, 8, (1.0, 4.0))
        loaded = next(
            load_batches(sampler, QUICK, range(4), Group(CPU), Execution(workers=workers))
        )
        assert loaded.batch is None and isinstance(loaded.failure, DataError)
        assert "truncated or damaged" in loaded.news[0]


class Deadly(CropSampler):
    """Its process is killed, as the system does when memory runs out."""

    def sample(self, seed, step, index):
        os._exit(9)


def test_a_worker_that_is_killed_ends_the_run_with_one_sentence(tmp_path):
    sampler = Deadly(write_pictures(tmp_path / "pictures"), 8, (1.0, 4.0))
    with pytest.raises(DataError, match="fewer --workers"):
        next(load_batches(sampler, QUICK, range(4), Group(CPU), Execution(workers=1)))
