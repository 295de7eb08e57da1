"""The records of splats that a lens shows, and the columns in which sixteen of them are made.

There are two kinds in one list. A large splat is evaluated in 3D along each pixel's ray: see
`lens_project_kernels`. A small one is an ellipse of the image, with the columns U to L22, RADIUS_X,
RADIUS_Y and BLOCK_REACH of a pinhole's: see `lens_small_kernels`. Columns 6 to 8 are the colour of
both.
"""

# Numba's decorators and vector types are untyped.
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"

import numpy as np

from alpasim_plugin.core.kernels import kernel
from alpasim_plugin.gaussians.constants import TILE
from alpasim_plugin.gaussians.raster import simd as v
from alpasim_plugin.gaussians.raster.lens_rays import LENS_HEIGHT, LENS_WIDTH

ROW_A, ROW_B, ROW_C = 0, 3, 9  # of large splats
INVERSE_O2 = 12  # negative: a small splat
PEAK, DEPTH = 13, 14
CUT_SIGMA = 15  # of large splats
# Large splats of a rolling shutter have these as well.
ROW_S = 16  # s1, s2, s3 of the motion in a whole shutter
NODE, DISTANCE = 25, 26  # the place of its motion, -1: it does not turn; n
PASSED = 27  # 1: the camera may pass it, or be in it, while the shutter is open
SHORT, LONG = 16, 32  # numbers of a record
# Further columns of the lanes in which sixteen records are made.
LEFT, RIGHT, TOP, BOTTOM, KEY = range(LONG, LONG + 5)
COLUMNS = LONG + 5


@kernel
def store3(lanes, column, a):
    """Store a vector of three."""
    for k in range(3):
        v.store(lanes, (column + k) * 16, v.to_f32(a[k]))


@kernel
def _tile_number(place, n_tiles):
    """Return the tile of a place in pixels, held to 0..n_tiles; rounded down."""
    return np.int16(min(max(place / TILE, 0.0), np.float64(n_tiles)))


@kernel
def write_record(lanes, lane, lens, out, size, records, boxes):
    """Write the record and the tiles of the box of a lane's Gaussian; ``size`` says how many numbers
    a record has, and how many of them are written.
    """
    for column in range(size[1]):
        records[out * size[0] + column] = lanes[column * 16 + lane]
    tiles_x = -(-int(lens[LENS_WIDTH]) // TILE)
    tiles_y = -(-int(lens[LENS_HEIGHT]) // TILE)
    boxes[out, 0] = _tile_number(lanes[LEFT * 16 + lane] - 0.5, tiles_x)
    boxes[out, 1] = _tile_number(lanes[RIGHT * 16 + lane] - 0.5 + TILE, tiles_x)
    boxes[out, 2] = _tile_number(lanes[TOP * 16 + lane] - 0.5, tiles_y)
    boxes[out, 3] = _tile_number(lanes[BOTTOM * 16 + lane] - 0.5 + TILE, tiles_y)
