"""Time blocks of ``onefixer-dit-tiny`` for several widths of its autoencoder: ``python
docs/scripts/fixer_widths.py [THREADS]``.

Random frames of 256x144 with holes and semantic maps, chunk by chunk. Random weights stand in for
the shipped ones, whose sizes are fixed; the history is kept from the last forward (`finalise`, as
shipped, adds a forward a block). Prints milliseconds a frame: the median of blocks 3 to 10, in two
rounds. Needs free cores: with two threads on busy ones it measures how long they wait for each
other.
"""

import sys
import time

import numpy as np
import torch

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import Frame
from alpasim_plugin.fixers import fixer_settings, make_fixer

WIDTHS = ("64,96,96,64,48", "48,64,64,48,32", "32,64,64,32,32", "32,48,48,32,16")
UNTRAINED = ("weights.bundle=null", "untrained=random", "holes=render", "history=last-forward")
BLOCKS, SIZE = 10, (144, 256)


def ms_a_frame(widths: str, threads: int) -> float:
    """Return the median time a frame of one fixer's blocks after the second."""
    settings = fixer_settings("onefixer-dit-tiny", [f"vae.widths=[{widths}]", *UNTRAINED])
    fixer = make_fixer("onefixer-dit-tiny", settings, scene_id="widths", threads=threads)
    rng = stream("widths", 0, "frames")
    t_us = 0
    spent = []
    for block in range(BLOCKS):
        n = fixer.blocks.frames(block)
        images = rng.integers(0, 256, (2, n, *SIZE, 3), dtype=np.uint8)
        alpha = rng.random((n, *SIZE), dtype=np.float32)
        frames = [Frame(t_us + i, "front", images[0, i], alpha[i]) for i in range(n)]
        t_us += n
        began = time.perf_counter()
        fixer.step(frames, list(images[1]))
        spent.append(1e3 * (time.perf_counter() - began) / n)
    return float(np.median(spent[2:]))


if __name__ == "__main__":
    threads = int(sys.argv[1]) if len(sys.argv) > 1 else torch.get_num_threads()
    for widths in WIDTHS * 2:
        print(f"{widths:>16}  {ms_a_frame(widths, threads):6.1f} ms a frame", flush=True)
