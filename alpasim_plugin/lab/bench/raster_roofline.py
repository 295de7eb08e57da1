"""Roofline of the CPU rasteriser: the least time of a core for the work that the definition of an
image asks for.

Work is counted: Gaussians that reach the image, and splats blended into a pixel by the float64
reference (`rasterize_reference`). What a core can do is measured: products of float32 matrices, and
copies of an array far larger than the caches. Nothing that a tiled rasteriser does besides
(bounding spheres, sorting by depth and tile, splats evaluated where they turn out invisible) is in
the work, so the floor is below what any such rasteriser can reach.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.gaussians.constants import GEO_SIZE, RECORD

# Operations of a blend: distance from the centre 2, in units of the ellipse 4, squared 3,
# exponential 13 (polynomial of degree 5, then its eighth power), alpha 2, weight 1, three colours
# and depth 8, transmittance 1.
BLEND_FLOPS = 34
# Of a visible Gaussian: into the camera 18, slopes and Jacobian 20, its covariance 60, eigenvalues
# and extent 20, view direction 10, and harmonics: the basis 40, 2 for each coefficient of each
# colour.
PROJECT_FLOPS, FLOPS_PER_COEFFICIENT = 168, 6
FLOAT32 = 4
MEAN_BYTES, PIXEL_BYTES = 24, 5 * FLOAT32  # a float64 position; colour, alpha and depth of a pixel
MATRIX = 768
ARRAY = 1 << 24
TURNS = 5


@dataclass(frozen=True)
class Core:
    """What one core can do.

    Attributes:
        flops: Operations per second, float32.
        bandwidth: Bytes per second, read and written.
    """

    flops: float
    bandwidth: float


@dataclass(frozen=True)
class RasterWork:
    """Work of one frame, all cameras together.

    Attributes:
        visible: Gaussians that reach an image.
        blends: Splats blended into a pixel, over all pixels.
        pixels: Of all images.
        sh_size: Coefficients of harmonics per colour.
    """

    visible: int
    blends: int
    pixels: int
    sh_size: int

    def floor_ms(self, core: Core) -> float:
        """Return the least milliseconds of one core: projecting, then blending, each the slower of
        arithmetic and memory.

        Example:
            >>> RasterWork(visible=0, blends=1_000_000, pixels=0, sh_size=16).floor_ms(Core(flops=34e9, bandwidth=1e12))
            1.0
        """
        record = RECORD * FLOAT32
        stages = (
            (
                self.visible * (PROJECT_FLOPS + FLOPS_PER_COEFFICIENT * self.sh_size),
                self.visible * (MEAN_BYTES + FLOAT32 * (GEO_SIZE + 3 * self.sh_size) + record),
            ),
            (self.blends * BLEND_FLOPS, self.visible * record + self.pixels * PIXEL_BYTES),
        )
        return 1e3 * sum(max(flops / core.flops, moved / core.bandwidth) for flops, moved in stages)


def measure_core() -> Core:
    """Measure a core in processor time, which other work on the machine does not stretch much;
    libraries may use several threads.
    """
    generator = np.random.Generator(np.random.Philox(0))
    left, right = generator.random((2, MATRIX, MATRIX), dtype=np.float32)
    source, target = np.ones(ARRAY, np.float32), np.zeros(ARRAY, np.float32)
    return Core(
        2.0 * MATRIX**3 / _least_s(lambda: left @ right),
        2.0 * source.nbytes / _least_s(lambda: np.copyto(target, source)),
    )


def _least_s(call: Callable[[], object]) -> float:
    took = []
    for _ in range(TURNS):
        began = time.process_time()
        call()
        took.append(time.process_time() - began)
    return min(took[1:])
