"""The objectives of a generator in pixels on one shared rollout (OneFixer, Sec. 3.2 and 3.3), frame
by frame.

    rollout      x^i = G(z^i_1 | state^<i)                        the deployed step, with gradients through the last k frames
    picture      | x^i - x^i_0 |                                  at every frame; pixels of road users count more
    perceptual   d(x^w, x^w_0)                                    at sampled frames w
    temporal     | (x^i - x^i-1) - (x^i_0 - x^i-1_0) |            differences of neighbouring frames
    grid         evenness of steps over the generator's cells     `training.grid_term`
    choice       - sum_k q_k log p_k                              the blend p of render and references, q: which of them is near the truth
    flow         | v(z^i_t, t | sg(state^<i)) - (z^i_1 - x^i_0) | at sampled frames and times, on the history of the rollout

The choice term is there because a weight near 0 has no gradient through the picture: a blend that
never takes a reference would never learn when it should. Its aim is q_k = softmax(log v_k - e_k /
s), without gradients; e_k is the error of source k around a pixel, and v_k says where it holds.

With x_0-prediction, v = (z_t - x_0) / t, so the flow term is the error of x_0 over t. Names as in
the paper: ``z_1`` source, ``m`` mask, ``eps`` noise, ``sg`` stop-gradient. All random numbers are
arguments. The state enters from the batch before and leaves to the next one, without gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.fixers.network.pixel_generator import PixelGenerator, PixelState, pixel_source
from alpasim_plugin.fixers.network.reference_blend import Sources, mix, sources_of
from alpasim_plugin.fixers.network.schedule import interpolant
from alpasim_plugin.lab.training.grid_term import grid_term

History = Literal["own", "clean", "redenoised"]
Distance = Callable[[Tensor, Tensor], Tensor]  # images (F, 3, H, W) in [-1, 1], twice -> (F,)
NEAR = 0.02  # s of the choice term, of a range of 2
AROUND = 5  # pixels of the side over which errors are averaged
ROAD_USER = 4  # a policy looks at road users, who are few pixels
EARLIEST = 0.3  # times below it count as this one in the weight 1 / t of the flow term


def detached(state: PixelState) -> PixelState:
    """Return the same values, cut off from the graph that made them."""
    return PixelState(*(part.detach() for part in state))


def restarted(state: PixelState, fresh: Tensor, start: PixelState) -> PixelState:
    """Return the state with the clips that ``fresh`` ``(B,)`` marks taken from ``start``."""
    restart_mask = fresh[:, None, None, None]
    return PixelState(
        *(torch.where(restart_mask, new, old) for new, old in zip(start, state, strict=True))
    )


@dataclass(frozen=True)
class PixelObjectives:
    """Weights of the terms, and the axes of the ablation.

    Args:
        perceptual, temporal, flow, picture, grid, choice: Weights of the terms; 0 switches a term
            off.
        horizon: k, frames that gradients pass through; 1 cuts the history at every frame.
        history: What the state holds of the past: the generator's ``own`` outputs, the truth in
            their place (``clean``), or the truth that the generator noised and denoised again
            (``redenoised``; no gradient passes through it).
        use_map: Whether the map is given; otherwise it is black.
        source: Eq. 1 (``mixed``), noise everywhere with the render as a condition (``noise``), or
            the render alone (``render``).
    """

    perceptual: float = 0.1
    temporal: float = 0.25
    flow: float = 0.25
    horizon: int = 4
    history: History = "own"
    use_map: bool = True
    source: Literal["mixed", "noise", "render"] = "mixed"
    picture: float = 1.0
    grid: float = 0.01
    choice: float = 0.05

    @property
    def in_pixels(self) -> bool:
        """Whether a term is computed on the deployed step, so that gradients pass through the
        rollout.
        """
        return bool(self.picture or self.perceptual or self.temporal or self.grid)


@dataclass(frozen=True)
class PixelSample:
    """Consecutive frames of B clips with the noise of a training step; images are ``(B, T, H, W,
    C)``.

    Args:
        render, truth, sdmap: In [-1, 1].
        opacity: 0 to 1, one channel.
        eps: Standard normal, like ``render``.
        eps_flow: Of the flow term, like one frame: ``(B, H, W, 3)``.
        t: ``(B,)`` uniform in 0..1, times of the flow term.
        flow_frame: Frame of the flow term.
        perceptual_frames: Frames of the perceptual term.
        corner: Row and column from which the perceptual term sees the frames. Its network halves
            the resolution four times; from a fixed corner its grid would lie on the generator's,
            which then learns a pattern of period 4 that only this network prefers.
        t_history: ``(B, T)`` uniform in 0..1, noise levels of a re-denoised history.
        references: ``(B, T, K, H, W, 4)`` recorded frames in the view: colour in [-1, 1], and where
            it holds, 0 to 1. None: there is none.
        road_users: ``(B, T, H, W, 1)`` bool; pixels whose errors count `ROAD_USER` times. None: all
            count alike.
    """

    render: Tensor
    truth: Tensor
    sdmap: Tensor
    opacity: Tensor
    eps: Tensor
    eps_flow: Tensor
    t: Tensor
    flow_frame: int
    perceptual_frames: Sequence[int]
    corner: tuple[int, int]
    t_history: Tensor
    references: Tensor | None = None
    road_users: Tensor | None = None


@dataclass(frozen=True)
class PixelLosses:
    """Terms of one batch; ``predictions`` is ``(B, T, H, W, 3)``, not clipped."""

    total: Tensor
    picture: Tensor
    perceptual: Tensor
    temporal: Tensor
    flow: Tensor
    grid: Tensor
    choice: Tensor
    predictions: Tensor
    state: PixelState  # after the last frame, detached


def pixel_losses(
    net: PixelGenerator,
    sample: PixelSample,
    state: PixelState,
    objectives: PixelObjectives,
    distance: Distance | None,
) -> PixelLosses:
    """Roll the generator out over the sample's frames and return the objectives.

    Args:
        net: The generator.
        sample: Frames and noise.
        state: Before the first frame, without gradients.
        objectives: Weights.
        distance: Perceptual distance; None switches its term off.
    """
    frames = sample.render.shape[1]
    zero = sample.render.new_zeros(())
    outputs = []
    flow = zero
    choice = zero
    for i in range(frames):
        frame = _frame(sample, i, objectives)
        if objectives.flow and i == sample.flow_frame:
            flow = _flow_term(net, frame, detached(state), sample, objectives)
        if i and i % objectives.horizon == 0:
            state = detached(state)
        before = state
        source = _source(frame.render, frame.opacity, sample.eps[:, i], objectives)
        with torch.set_grad_enabled(objectives.in_pixels):
            out, state, sources = with_sources(
                net, frame.render, frame.opacity, frame.sdmap, before, source, frame.references
            )
        outputs.append(out)
        if objectives.choice and sources is not None:
            choice = choice + choice_term(sources, frame.truth) / frames
        if objectives.history == "clean":
            state = state._replace(output=frame.truth)
        elif objectives.history == "redenoised":
            with torch.no_grad():
                _, state = _denoised(net, frame, before, source, sample.t_history[:, i])
    made = torch.stack(outputs, dim=1)
    return _weighed(made, sample, flow, choice, detached(state), objectives, distance)


@dataclass(frozen=True)
class _Frame:
    """One frame of a sample, as the generator and the terms see it; see `PixelSample`."""

    render: Tensor
    opacity: Tensor
    sdmap: Tensor
    references: Tensor | None
    truth: Tensor


def _frame(sample: PixelSample, i: int, objectives: PixelObjectives) -> _Frame:
    """Return frame i of a sample."""
    render = sample.render[:, i]
    return _Frame(
        render=render,
        opacity=sample.opacity[:, i],
        sdmap=sample.sdmap[:, i] if objectives.use_map else torch.full_like(render, -1.0),
        references=None if sample.references is None else sample.references[:, i],
        truth=sample.truth[:, i],
    )


def _denoised(
    net: PixelGenerator, frame: _Frame, state: PixelState, source: Tensor, t: Tensor
) -> tuple[Tensor, PixelState]:
    """Noise the truth of a frame up to times ``t`` ``(B,)``, and let the generator clean it."""
    noisy = interpolant(frame.truth, source, t[:, None, None, None])
    return net(frame.render, frame.opacity, frame.sdmap, state, noisy, t, frame.references)


def _flow_term(
    net: PixelGenerator,
    frame: _Frame,
    state: PixelState,
    sample: PixelSample,
    objectives: PixelObjectives,
) -> Tensor:
    """Return the flow term of a frame."""
    source = _source(frame.render, frame.opacity, sample.eps_flow, objectives)
    guess, _ = _denoised(net, frame, state, source, sample.t)
    t = sample.t[:, None, None, None]
    return ((guess - frame.truth).abs() / t.clamp(min=EARLIEST)).mean()


def _weighed(
    made: Tensor,
    sample: PixelSample,
    flow: Tensor,
    choice: Tensor,
    state: PixelState,
    objectives: PixelObjectives,
    distance: Distance | None,
) -> PixelLosses:
    """Return the terms on the frames that were made, ``(B, T, H, W, 3)``, and their weighted sum."""
    zero = sample.render.new_zeros(())
    frames = made.shape[1]
    weight = _pixel_weights(sample)
    picture = (weight * (made - sample.truth).abs()).mean()
    moved = (made[:, 1:] - made[:, :-1]) - (sample.truth[:, 1:] - sample.truth[:, :-1])
    temporal = (weight[:, 1:] * moved.abs()).mean() if objectives.temporal and frames > 1 else zero
    perceptual = zero
    if objectives.perceptual and distance is not None:
        perceptual = _perceptual_term(made, sample, distance)
    grid = grid_term(made, sample.truth) if objectives.grid else zero
    total = (
        objectives.picture * picture
        + objectives.perceptual * perceptual
        + objectives.temporal * temporal
    )
    total = total + objectives.grid * grid + objectives.flow * flow + objectives.choice * choice
    return PixelLosses(total, picture, perceptual, temporal, flow, grid, choice, made, state)


def _pixel_weights(sample: PixelSample) -> Tensor:
    """Return the weight of each pixel, larger on road users; its mean in each row of the batch is 1,
    so that the loss of rows is the mean of theirs.
    """
    weight = torch.ones_like(sample.opacity)
    if sample.road_users is not None:
        weight = weight + (ROAD_USER - 1) * sample.road_users
    return weight / weight.mean(dim=tuple(range(1, weight.ndim)), keepdim=True)


def _perceptual_term(made: Tensor, sample: PixelSample, distance: Distance) -> Tensor:
    """Return the perceptual distance of some frames to the truth, in the sample's crop."""
    top, left = sample.corner
    chosen = list(sample.perceptual_frames)
    images, truth = (
        video[:, chosen, top:, left:].flatten(0, 1).permute(0, 3, 1, 2)
        for video in (made, sample.truth)
    )
    return distance(images, truth).mean()


def with_sources(
    net: PixelGenerator,
    render: Tensor,
    opacity: Tensor,
    sdmap: Tensor,
    state: PixelState,
    source: Tensor,
    references: Tensor | None,
) -> tuple[Tensor, PixelState, Sources | None]:
    """Predict the clean frame as the generator does, and return what it was blended of."""
    made = net.repair(render, opacity, sdmap, state, source, None, references)
    out, recorded, sources = made.image, torch.zeros_like(opacity), None
    if made.heads is not None and references is not None:
        sources = sources_of(out, references, made.heads)
        out, recorded = mix(sources)
    return out, PixelState(out.clamp(-1, 1), render, made.hidden, recorded), sources


def choice_term(sources: Sources, truth: Tensor) -> Tensor:
    """Return how far the blend is from the sources that are near the truth ``(B, H, W, 3)``:
    cross-entropy, nats.
    """
    b, k, h, w, _ = sources.colour.shape
    with torch.no_grad():
        error = (sources.colour - truth[:, None]).abs().mean(dim=-1).flatten(0, 1)[:, None]
        around = F.avg_pool2d(error, AROUND, 1, AROUND // 2, count_include_pad=False).view(
            b, k, h, w
        )
        aim = (sources.holds[..., 0].log() - around / NEAR).softmax(dim=1)
    return -(aim * sources.logit[..., 0].log_softmax(dim=1)).sum(dim=1).mean()


def _source(render: Tensor, opacity: Tensor, eps: Tensor, objectives: PixelObjectives) -> Tensor:
    if objectives.source == "render":
        return render
    return pixel_source(render, opacity, eps) if objectives.source == "mixed" else eps
