"""What a `Trainer` needs of the generator in pixels: batches with their noise, the loss, and the
state that goes on between updates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed, stream
from alpasim_plugin.fixers.network.pixel_generator import GRID_PX, PixelGenerator, PixelState
from alpasim_plugin.lab.training.pixel_rollout import (
    Distance,
    PixelSample,
    pixel_losses,
    restarted,
)
from alpasim_plugin.lab.training.pixel_variants import PixelVariant

SEEN = 2  # frames of the perceptual term in an update


class FrameBatch(Protocol):
    """Consecutive frames of B streams; images ``(B, T, C, H, W)``, as
    `alpasim_plugin.lab.training.streams.StreamBatch` holds them.
    """

    @property
    def render(self) -> Tensor:
        """Degraded frames, in [-1, 1]."""
        ...

    @property
    def opacity(self) -> Tensor:
        """Theirs, 0 to 1, one channel."""
        ...

    @property
    def map(self) -> Tensor:
        """Semantic maps in [-1, 1]; -1 is black, or no map."""
        ...

    @property
    def target(self) -> Tensor:
        """Clean frames, in [-1, 1]."""
        ...

    @property
    def references(self) -> Tensor | None:
        """``(B, T, K, H, W, 4)`` recorded frames in the view; None where there is none."""
        ...

    @property
    def road_users(self) -> Tensor:
        """``(B, T, 1, H, W)`` bool; what shows a road user's box."""
        ...

    @property
    def fresh(self) -> Tensor:
        """``(B,)`` whether a stream starts anew at this update."""
        ...


class FrameStreams(Protocol):
    """Batches by number of update."""

    def update(self, i: int, slots: Sequence[int]) -> FrameBatch:
        """Return the frames of some streams at update ``i``, a function of these alone."""
        ...

    @property
    def batch(self) -> int:
        """Number of streams."""
        ...

    def facts(self) -> Mapping[str, Any]:
        """Return what identifies the data."""
        ...


@dataclass(frozen=True)
class NoisyBatch:
    """A batch with the noise of its update."""

    sample: PixelSample
    fresh: Tensor


class PixelTask:
    """Batches and loss of a run.

    Args:
        net: Trained.
        streams: Data.
        variant: Objectives, which may change in the course of the run.
        steps: Updates of the run, which a variant of several stages divides.
        distance: Name and function of the perceptual term, or None.
        seed: Of the noise.
        rank, ranks: Number of this process, and of all that share every batch: each has as many
            streams.

    Raises:
        InputError: The streams cannot be shared so.
    """

    def __init__(
        self,
        net: PixelGenerator,
        streams: FrameStreams,
        variant: PixelVariant,
        steps: int,
        distance: tuple[str, Distance] | None,
        seed: int = 0,
        rank: int = 0,
        ranks: int = 1,
    ) -> None:
        if streams.batch % ranks:
            raise InputError(
                f"{ranks} processes cannot share {streams.batch} streams",
                "make --streams a multiple of the processes",
            )
        count = streams.batch // ranks
        self._own = slice(rank * count, (rank + 1) * count)
        self.net, self.streams, self.variant, self.steps, self.distance, self.seed = (
            net,
            streams,
            variant,
            steps,
            distance,
            seed,
        )
        self._state: PixelState | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """What identifies the task."""
        named = self.distance and self.distance[0]
        return {
            "streams": dict(self.streams.facts()),
            "variant": self.variant.facts(self.steps),
            "sizes": self.net.facts,
            "distance": named,
            "seed": self.seed,
        }

    def batch(self, index: int) -> NoisyBatch:
        """Return the frames and noise of update ``index``, of this process's streams."""
        streams = self.streams.batch
        local_streams = self._own
        got = self.streams.update(index, range(streams)[local_streams])
        render, truth, sdmap, opacity = (
            x.permute(0, 1, 3, 4, 2).contiguous()
            for x in (got.render, got.target, got.map, got.opacity)
        )
        source = torch.Generator().manual_seed(
            derive_seed("training", self.seed, "pixel.noise", index) % 2**63
        )
        frames, *shape = render.shape[1:]
        # Drawn for all streams: the noise of one does not depend on the number of processes.
        eps = torch.randn((streams, frames, *shape), generator=source)[local_streams]
        eps_flow = torch.randn((streams, *shape), generator=source)[local_streams]
        t = torch.rand(streams, generator=source)[local_streams]
        rng = stream("training", self.seed, "pixel.frames", index)
        checked_frames = tuple(int(i) for i in rng.permutation(frames)[:SEEN])
        t_history = torch.rand(streams, frames, generator=source)[local_streams]
        flow_frame, top, left = (
            int(rng.integers(frames)),
            *(int(rng.integers(_corners(side))) for side in render.shape[2:4]),
        )
        users = got.road_users.permute(0, 1, 3, 4, 2).contiguous()
        sample = PixelSample(
            render,
            truth,
            sdmap,
            opacity,
            eps,
            eps_flow,
            t,
            flow_frame,
            checked_frames,
            (top, left),
            t_history,
            got.references,
            users,
        )
        return NoisyBatch(sample, got.fresh)

    def loss(self, batch: NoisyBatch, index: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of an update and what is logged; the state goes on to the next."""
        sample = batch.sample
        start = self.net.start(sample.render[:, 0])
        state = start if self._state is None else restarted(self._state, batch.fresh, start)
        distance = None if self.distance is None else self.distance[1]
        losses = pixel_losses(
            self.net, sample, state, self.variant.objectives(index, self.steps), distance
        )
        self._state = losses.state
        made, render_psnr = (
            _psnr_db(x, sample.truth) for x in (losses.predictions.detach(), sample.render)
        )
        # Renders that are the truth, or nearly, say nothing about repair.
        degraded = render_psnr < 40
        gain = ((made - render_psnr) * degraded).sum() / degraded.sum().clamp(min=1)
        return losses.total, {
            "picture": losses.picture.detach(),
            "perceptual": losses.perceptual.detach(),
            "temporal": losses.temporal.detach(),
            "flow": losses.flow.detach(),
            "grid": losses.grid.detach(),
            "choice": losses.choice.detach(),
            "psnr_db": made.mean(),
            "gain_db": gain,
        }

    def carried(self) -> Mapping[str, Tensor]:
        """Return the state after the last update."""
        return {} if self._state is None else self._state._asdict()

    def carry(self, tensors: Mapping[str, Tensor]) -> None:
        """Take a checkpoint's state, of all streams."""
        state = {name: part[self._own] for name, part in tensors.items()}
        self._state = PixelState(**state) if state else None


def _corners(side: int) -> int:
    """Return from how many places along a side the perceptual term may begin, so that at least a
    cell of its coarsest grid is left.
    """
    return max(min(GRID_PX, side - GRID_PX + 1), 1)


def _psnr_db(images: Tensor, truth: Tensor) -> Tensor:
    """Return the PSNR of every stream ``(B,)``, values in [-1, 1]."""
    mse = (images.clamp(-1, 1) - truth).square().flatten(1).mean(1)
    return -10 * torch.log10(mse / 4 + 1e-9)
