"""Say where the weights of `finer_weights.py` gain: PSNR over regions of the images of val.

python docs/scripts/finer_regions.py FOLDER head.pt
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from finer_weights import CHANNELS, FINER_PX, HALF, HEIGHT, VAL, FinerWeights, Pair

EDGE, AROUND_PX = 60.0, 5  # grey levels of a Sobel filter; how far an edge reaches


def errors_of(pair, added):
    """The squared error of each pixel of the mixed image, of a range of 2."""
    up = F.interpolate(added, scale_factor=FINER_PX, mode="bilinear")[..., None]
    logit = pair.logit.float()
    shares = torch.cat([logit[:, :1], logit[:, 1:] + up], dim=1).softmax(dim=1)
    mixed = (shares * pair.colour.float()).sum(dim=1)[0]
    return (mixed - pair.truth).square().mean(dim=-1).numpy()


def regions_of(truth):
    """Edges and surfaces of the lower and the upper half of an image, by name."""
    grey = cv2.cvtColor(truth, cv2.COLOR_RGB2GRAY).astype(np.float32)
    slope = np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1))
    edge = cv2.dilate((slope > EDGE).astype(np.uint8), np.ones((AROUND_PX, AROUND_PX))) > 0
    lower = np.arange(HEIGHT)[:, None] >= HEIGHT // 2
    whole = np.ones_like(edge)
    return {
        "all": whole,
        "edges, lower half": edge & lower,
        "edges, upper half": edge & ~lower,
        "surfaces, lower half": ~edge & lower,
        "surfaces, upper half": ~edge & ~lower,
    }


@torch.no_grad()
def main(folder, head):
    """Print one line for each region."""
    net = FinerWeights(CHANNELS)
    net.load_state_dict(torch.load(head))
    sums = {}
    for scene in VAL:
        for part in torch.load(Path(folder) / f"{scene}.pt"):
            pair = Pair(part)
            added = pair.added(net)
            before, after = errors_of(pair, 0 * added), errors_of(pair, added)
            truth = ((pair.truth + 1) * HALF).round().byte().numpy()
            for name, mask in regions_of(truth).items():
                row = np.array([mask.sum(), before[mask].sum(), after[mask].sum()])
                sums[name] = sums.get(name, 0) + row
    for name, (count, *both) in sums.items():
        before, after = (10 * np.log10(4 * count / one) for one in both)
        share = count / sums["all"][0]
        print(f"{name}, {share:.0%} of the pixels: {before:.2f} -> {after:.2f} dB")


if __name__ == "__main__":
    main(*sys.argv[1:])
