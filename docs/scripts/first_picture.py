"""Make the README's picture from a run of its main job.

    python docs/scripts/first_picture.py RUN

RUN is its run folder.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from results import DOCS

RENDERERS = ("clean", "3dgs", "onefixer")
SCENE = "hard-sharp_s_curve"
FRAMES, SHOWN = 4, (0, 1, 3)  # of a strip
QUALITY = 84


def main() -> None:
    """Lay three frames of each renderer's strip below one another."""
    rows = []
    for renderer in RENDERERS:
        file = Path(sys.argv[1]) / "rollouts" / renderer / "lane-camera" / SCENE / "0" / "strip.jpg"
        strip = cv2.imread(str(file))
        if strip is None:
            sys.exit(f"{file} is no picture; run the README's main job first")
        frames = np.split(strip, FRAMES, axis=1)
        rows.append(np.concatenate([frames[i] for i in SHOWN], axis=1))
    cv2.imwrite(str(DOCS / "img" / "first.jpg"), np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
