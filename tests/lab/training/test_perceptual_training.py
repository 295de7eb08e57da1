"""Training of the perceptual distance: damage that is monotone, targets that say so, batches that
repeat, module that are learned.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32
from alpasim_plugin.lab.training.distortions import KINDS, draw_distortion
from alpasim_plugin.lab.training.perceptual import PerceptualRecipe, PerceptualTask, draw_shapes
from alpasim_plugin.lab.training.perceptual_check import SeveritySweep, check, shift_one_px
from alpasim_plugin.lab.training.perceptual_targets import (
    GAINS,
    colour_error,
    structure_error,
    target_distance,
)
from alpasim_plugin.lab.training.semantics import CLASSES, class_masks
from alpasim_plugin.lab.training.trainer import Schedule, Trainer
from alpasim_plugin.lab.video_metrics.perceptual_net import PerceptualDistance, load_perceptual
from tests.lab.training.pair_files import make

PICTURE: F32 = draw_shapes(stream("training", 0, "picture"), 64)


@pytest.mark.parametrize("kind", KINDS)
def test_damage_begins_at_nothing_and_its_target_grows(kind: str) -> None:
    found = []
    for i in range(4):
        damage = draw_distortion(stream("training", i, kind), PICTURE.shape, kind)
        assert damage.kind == kind
        assert np.array_equal(damage(PICTURE, 0.0), PICTURE)
        made = [damage(PICTURE, s) for s in (0.1, 0.5, 1.0)]
        assert all(
            m.shape == PICTURE.shape and m.dtype == np.float32 and m.min() >= 0 and m.max() <= 1
            for m in made
        )
        found.append(
            [
                target_distance(PICTURE, m, kind, damage.displacement_px(s))
                for m, s in zip(made, (0.1, 0.5, 1.0), strict=True)
            ]
        )
    assert np.all(np.diff(np.mean(found, axis=0)) > 0)


def test_the_same_draw_damages_the_same_way() -> None:
    for kind in KINDS:
        a, b = (
            draw_distortion(stream("training", 1, kind), PICTURE.shape, kind)(PICTURE, 0.5)
            for _ in range(2)
        )
        assert np.array_equal(a, b)


def test_every_kind_has_a_gain_or_a_displacement() -> None:
    for kind in KINDS:
        moved = draw_distortion(stream("training", 0, kind), PICTURE.shape, kind).displacement_px(
            1.0
        )
        assert (kind in GAINS) != (moved > 0)


def test_equal_pictures_have_no_error_and_a_colour_cast_is_no_structure() -> None:
    assert structure_error(PICTURE, PICTURE) == pytest.approx(0.0, abs=1e-6)
    assert colour_error(PICTURE, PICTURE) == 0.0
    flat = np.full((32, 32, 3), 0.5, dtype=np.float32)
    cast = flat + np.array([0.2, 0.0, 0.0], dtype=np.float32)
    assert structure_error(flat, cast) == pytest.approx(0.0, abs=1e-6)
    assert colour_error(flat, cast) == pytest.approx(0.2 / 3, rel=1e-5)


def test_map_colours_are_read_back_however_faded() -> None:
    colours = {
        "boundary": (253, 1, 232),
        "white line": (255, 255, 255),
        "yellow line": (255, 255, 0),
        "crosswalk": (139, 93, 255),
    }
    colours |= {"vehicle": (126, 206, 255), "other road user": (255, 124, 171)}
    for fade in (1.0, 0.5, 0.25):
        for name, colour in colours.items():
            sdmap = np.zeros((8, 8, 3), dtype=np.uint8)
            sdmap[0, 4] = np.array(colour) * fade
            masks = class_masks(sdmap, 4)
            assert masks.shape == (len(CLASSES), 2, 2)
            assert masks[CLASSES.index(name), 0, 1] == 1
            assert masks.sum() == 1


SMALL = PerceptualRecipe(images=3, side=32)


@pytest.fixture
def task(tmp_path: Path) -> PerceptualTask:
    return PerceptualTask([make(tmp_path / "pairs", height=48, width=64)], SMALL)


def test_batch_depends_on_its_number_alone(task: PerceptualTask) -> None:
    first = task.batch(7)
    task.batch(8)
    again = task.batch(7)
    assert torch.equal(first.damaged, again.damaged)
    assert torch.equal(first.targets, again.targets)
    assert not torch.equal(first.clean, task.batch(8).clean)
    assert torch.all(first.targets[1] >= first.targets[0] - 1e-3)  # the stronger damage of a kind


def test_every_loss_term_reaches_the_trunk(task: PerceptualTask) -> None:
    batch = task.batch(0)
    loss, parts = task.loss(batch, 0)
    loss.backward()
    assert {"distance", "order", "semantics", "readout"} <= set(parts)
    assert all(np.isfinite(list(parts.values())))
    for name, p in task.module.named_parameters():
        assert p.grad is not None, name
        assert torch.isfinite(p.grad).all(), name


@pytest.mark.slow
def test_training_lowers_the_loss_and_the_result_loads(
    task: PerceptualTask, tmp_path: Path
) -> None:
    schedule = Schedule(6, peak_lr=6e-3, warmup=1)
    trainer = Trainer(
        task.module, tmp_path / "run", schedule, lambda i: task.batch(0), task.loss, task.facts
    )
    seen: list[float] = []
    trainer.run(lambda step, numbers: seen.append(numbers["loss"]))
    assert seen[-1] < 0.8 * seen[0]
    task.module.load_state_dict(trainer.averaged())
    task.module.net.save(tmp_path / "net.safetensors")
    for a, b in zip(
        task.module.net.parameters(),
        load_perceptual(tmp_path / "net.safetensors").parameters(),
        strict=True,
    ):
        assert torch.equal(a.detach().half().float(), b)


def test_check_tells_a_good_distance_from_a_bad_one() -> None:
    frames = np.stack([draw_shapes(stream("training", i, "check"), 48) for i in range(2)])

    def squared(a: F32, b: F32) -> np.ndarray:
        return ((a - b) ** 2).mean(axis=(1, 2, 3)).astype(np.float64)

    good, bad = check(squared, frames), check(lambda a, b: -squared(a, b), frames)
    assert good["rank_correlation"] > 0.4 > bad["rank_correlation"]
    assert np.mean(list(good["in_order"].values())) > 0.9
    assert np.mean(list(bad["in_order"].values())) < 0.1
    assert SeveritySweep(np.zeros((1, 3)), np.array([[0.1, 0.2, 0.3]])).in_order == 0.0


def test_shift_moves_by_one_pixel() -> None:
    right, down = shift_one_px(PICTURE[None])
    assert np.array_equal(right[0, :, 1:], PICTURE[:, :-1])
    assert np.array_equal(down[0, 1:], PICTURE[:-1])


def test_untrained_network_has_no_dead_stage() -> None:
    torch.manual_seed(0)
    net = PerceptualDistance()
    with torch.no_grad():
        features = net.trunk(torch.from_numpy(PICTURE).permute(2, 0, 1)[None] * 2 - 1)
    assert [x.shape[-1] for x in features] == [32, 16, 8, 4]
    assert all(float(x.std()) > 0 for x in features)
