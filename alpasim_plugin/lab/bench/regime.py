"""Roll per-frame generators out on histories of three kinds, and say of every frame how much there
was to repair and for how long it ran.

A history is the generator's ``own`` outputs, the truth in their place (``oracle``: the most that a
better history can give), or nothing (``empty``: every frame begins anew). References are not read,
as in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.fixers.network.pixel_generator import HOLE, PixelGenerator
from alpasim_plugin.fixers.pixel_network import load_generator
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.bench.quality import RAW, Variant
from alpasim_plugin.lab.paper.regime import HISTORIES, OWN, RegimeClip, under
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.lab.training.reference_store import open_references
from alpasim_plugin.lab.video_metrics.frames import psnr_db

DOING = "measuring what a history is worth"


def measure_regime(
    sequences: Sequence[PairSequence],
    arms: Sequence[Variant],
    told: Callable[[int, int, str], None],
) -> list[RegimeClip]:
    """Measure every arm on every clip.

    Args:
        sequences: Clips.
        arms: Generators in pixels that take the render as their source, with their labels.
        told: Called after every clip with its number, their count and its name.

    Raises:
        InputError: An arm of another kind, or a clip without recorded poses.
    """
    nets = {arm.label: _generator(arm) for arm in arms}
    out = []
    for i, sequence in enumerate(sequences, start=1):
        clip = sequence.clip
        render, sdmap, truth = (
            torch.from_numpy(np.array(x)).float().div(127.5).sub(1)
            for x in (clip.rgb_input, clip.sdmap, clip.rgb_gt)
        )
        opacity = torch.from_numpy(np.array(clip.opacity)).float().div(255)[..., None]
        psnr = {
            under(name, history): psnr_db(
                _rollout(net, render, sdmap, truth, opacity, history), np.array(clip.rgb_gt)
            )
            for name, net in nets.items()
            for history in HISTORIES
        }
        psnr[RAW] = psnr_db(np.array(clip.rgb_input), np.array(clip.rgb_gt))
        holes = (opacity < HOLE).double().mean(dim=(1, 2, 3)).numpy()
        out.append(RegimeClip(sequence.name, holes, lateral_shift_m(sequence), psnr))
        told(i, len(sequences), sequence.name)
    return out


def lateral_shift_m(sequence: PairSequence) -> F64:
    """Return how far the camera is beside the recorded path at every frame ``(T,)``, metres.

    Raises:
        InputError: The sequence has no recorded poses.
    """
    recorded = open_references(sequence)
    if recorded is None or len(recorded.rgb_T_world_camera) < 2:
        raise InputError(
            f"{sequence.folder}: fewer than two recorded poses",
            "make the pairs with 'simrun train pairs'",
        )
    path, here = (
        recorded.rgb_T_world_camera[:, :2, 3],
        np.asarray(sequence.clip.T_world_camera)[:, None, :2, 3],
    )
    along = np.diff(path, axis=0)
    length = np.maximum((along**2).sum(-1), 1e-12)
    share = np.clip(((here - path[:-1]) * along).sum(-1) / length, 0.0, 1.0)
    nearest: F64 = np.linalg.norm(here - path[:-1] - share[..., None] * along, axis=-1).min(axis=1)
    return nearest


def _generator(arm: Variant) -> PixelGenerator:
    settings = arm.spec and arm.spec.settings
    if not isinstance(settings, PixelFixerSettings) or settings.holes != "render":
        raise InputError(
            f"{arm.label}: no generator in pixels whose source is the render",
            "give arms of 'simrun train per-frame --variant V9-still' or 'V3b-still'",
        )
    return load_generator(settings).net


def _rollout(
    net: PixelGenerator, render: Tensor, sdmap: Tensor, truth: Tensor, opacity: Tensor, history: str
) -> U8:
    """Return the frames ``(T, H, W, 3)`` that a generator makes on a history of a kind; images are
    ``(T, H, W, C)`` in [-1, 1].
    """
    made, state = [], net.start(render[:1])
    with torch.inference_mode():
        for i in range(len(render)):
            r = render[i : i + 1]
            m = sdmap[i : i + 1]
            o = opacity[i : i + 1]
            out, after = net(r, o, m, state if history != "empty" else net.start(r))
            state = after if history == OWN else after._replace(output=truth[i : i + 1])
            made.append(out[0].clamp(-1, 1).add(1).mul(127.5).round().to(torch.uint8))
    return torch.stack(made).numpy()
