"""Count what a frame costs a card at least: the table ``COUNTED`` of `alpasim_plugin.runs.gpu_work`.

    python -m alpasim_plugin.lab.bench.roofline [DEVICE]

With a card it also times blocks of the largest generator there, with random weights.

Operations are two a multiply-add, of products, convolutions and attention alone. Bytes are what
each of them reads and writes where everything between them is fused, and what a frame is made of
and results in. Counting computes nothing.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils.flop_counter import FlopCounterMode

from alpasim_plugin.core.devices import download, facts_of, require_device
from alpasim_plugin.core.printing import say
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.network.pixel_generator import TORCH
from alpasim_plugin.fixers.pixel_fixer import GivenFrame, fix_frame, in_range
from alpasim_plugin.fixers.pixel_network import load_generator
from alpasim_plugin.gaussians.constants import TILE
from alpasim_plugin.lab.bench.drawn_blocks import drawn_blocks
from alpasim_plugin.runs.gpu_check import LARGE, MIDDLE, median_ms
from alpasim_plugin.runs.gpu_work import H100, PEAKS, SPLATS, Work

PAIRS = 1.58  # of a splat and tiles: (1 + 2 h / 16)^2 for h = 2.06 px, where its alpha is 1/255
# Operations of `triton_kernels.project` a splat, and of `composite` a splat and pixel.
PROJECT_FLOP = 420
BLEND_FLOP = 23
# Bytes of a splat that is read, projected, and read again; of a pair of splat and tile that is
# listed, sorted and read; of a pixel.
SPLAT_BYTES = 260 + 2 * 72
PAIR_BYTES = 4 * 8
PIXEL_BYTES = 24
BLOCKS_BEFORE = 3  # until an attention window of six latents is full


class _Counter(TorchFunctionMode):
    """Counts products, convolutions and attention; use it inside ``with counter.flop, counter``."""

    def __init__(self) -> None:
        super().__init__()
        self.flop = FlopCounterMode(display=False)
        self.bytes = 0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        options = kwargs or {}
        before = self.flop.get_total_flops()
        made = func(*args, **options)
        if self.flop.get_total_flops() > before:
            self.bytes += _bytes_of(*args, *options.values(), made)
        return made


def _bytes_of(*parts: Any) -> int:
    return sum(part.nbytes for part in parts if isinstance(part, Tensor))


def _counted(call: Callable[[], Any], inputs: Sequence[Any] = ()) -> tuple[float, float]:
    """Return GFLOP and GB of a call, with the bytes of what it is given and returns."""
    counter = _Counter()
    with counter.flop, counter:
        made = call()
    moved = counter.bytes + _bytes_of(*inputs, *made)
    return round(counter.flop.get_total_flops() / 1e9, 2), round(moved / 1e9, 3)


def raster_work(width: int, height: int) -> Work:
    """Return the work of a frame of `transparent_splats`."""
    pairs = PAIRS * SPLATS
    flop = SPLATS * PROJECT_FLOP + pairs * TILE**2 * BLEND_FLOP
    moved = SPLATS * SPLAT_BYTES + pairs * PAIR_BYTES + width * height * PIXEL_BYTES
    return Work(round(flop / 1e9, 2), round(moved / 1e9, 3))


def fixer_work(cameras: int, width: int, height: int) -> Work:
    """Count a frame of ``onefixer`` with two recorded images a camera."""
    settings: Any = fixer_settings("onefixer")
    loaded = load_generator(settings)
    on_meta = replace(loaded, net=copy.deepcopy(loaded.net).to("meta"), operations=TORCH)
    image = torch.empty((cameras, height, width, 3), dtype=torch.uint8, device="meta")
    references = image.new_empty((cameras, 2, height, width, 4))
    reduced = TORCH.smaller(image, settings.scale_of(height, width))
    frame = GivenFrame(image, *on_meta.net.start(in_range(reduced)), None, image, references)
    return Work(*_counted(lambda: fix_frame(on_meta, settings, frame), frame))


def blocks(history: str, width: int, height: int, device: str) -> Callable[[], Tensor]:
    """Return a call that fixes one further block by ``onefixer-2b`` with random weights and a full
    attention window. On the device ``meta`` it computes nothing.
    """
    settings: Any = fixer_settings("onefixer-2b", [f"history={history}"])
    fix = drawn_blocks(settings, width, height, device)
    for _ in range(BLOCKS_BEFORE):
        fix()
    return fix


def block_work(history: str) -> Work:
    """Count a block of ``onefixer-2b``, of eight frames."""
    return Work(*_counted(blocks(history, *MIDDLE, "meta")), "bf16")


# By the names of the core's table, in the sizes that its check of a card times.
COUNTS: dict[str, Callable[[], Work]] = {
    "splats": partial(raster_work, *LARGE),
    "cameras: 1": partial(fixer_work, 1, *MIDDLE),
    "cameras: 6": partial(fixer_work, 6, *MIDDLE),
}
HISTORIES = "finalise", "last-forward"  # by what a block's history is made


def timed(device: str, history: str, work: Work) -> str:
    """Time blocks on a card; return the milliseconds and the share of its peak."""
    fix = blocks(history, *MIDDLE, device)
    ms = median_ms(lambda: download(fix().mean()))
    card = str(facts_of(device).get("card"))
    share = f"{work.least_ms(card) / ms:.2f} of its peak" if card in PEAKS else "peak not known"
    return f"{ms} ms on {card}, {share}"


def main() -> None:
    """Print the table, with the time that an H100 takes at its peak rates."""
    counts = COUNTS | {history: partial(block_work, history) for history in HISTORIES}
    for name, count in counts.items():
        work = count()
        say(f"{name}: {work}, {work.least_ms(H100)} ms at the peak of an {H100}")
        if name in HISTORIES and len(sys.argv) > 1:
            say(f"{name}: {timed(require_device(sys.argv[1]), name, work)}")


if __name__ == "__main__":
    main()
