"""Short trainings of a pixel generator."""

from dataclasses import dataclass

import torch
from torch import Tensor

from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.training.pixel_run import PixelRun
from alpasim_plugin.lab.training.pixel_variants import pixel_variant
from alpasim_plugin.lab.training.trainer import Schedule

SMALL = (
    "generator.widths=[8,8,8]",
    "generator.detail=8",
    "generator.hidden=4",
    "weights.bundle=null",
)
FRAMES = 3


@dataclass(frozen=True)
class Batch:
    """Like `training.streams.StreamBatch`."""

    render: Tensor
    opacity: Tensor
    map: Tensor
    target: Tensor
    fresh: Tensor
    road_users: Tensor
    references: Tensor | None = None


class Streams:
    """Two streams whose renders are darker than the truth; one starts anew at every third
    update.
    """

    batch = 2

    def update(self, i, slots=(0, 1)):
        source = torch.Generator().manual_seed(i)
        target = torch.rand(2, FRAMES, 3, 16, 32, generator=source) * 2 - 1
        opacity = torch.rand(2, FRAMES, 1, 16, 32, generator=source)
        users = torch.rand(opacity.shape, generator=source) < 0.1
        fresh = torch.tensor([i % 3 == 0, i == 0])
        whole = target * 0.5 - 0.4, opacity, target.roll(1, 2), target, fresh, users
        return Batch(*(part[list(slots)] for part in whole))

    def facts(self):
        return {"streams": "dark"}


def run_of(steps=4, decay_from=3, variant="V9", **changes):
    settings = fixer_settings("onefixer", SMALL)
    assert isinstance(settings, PixelFixerSettings)
    schedule = Schedule(
        steps, peak_lr=3e-3, warmup=2, clip=0.5, ema=0.9, save_every=2, decay_from=decay_from
    )
    return PixelRun(
        settings,
        Streams(),
        pixel_variant(variant).weighted(0, 0.25, 0.25, 0.01, horizon=4),
        schedule,
        **changes,
    )
