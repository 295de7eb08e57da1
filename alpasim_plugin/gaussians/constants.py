"""Constants of the splatting rule, shared by every backend, and the columns of the arrays that the
CPU kernels share.

Values are those of gsplat 1.6. Thresholds that decide what is drawn are the *float32* neighbours of
their decimal value, also in float64 code: whether a second saturated layer is drawn hangs on ``(1 -
0.99)**2 <= 1e-4``, which is true in float32 and false in float64.
"""

import math

import numpy as np

NEAR_M = 0.1  # a 5 cm splat closer than this smears over the whole frame
FAR_M = 1.0e10
EPS2D_PX2 = 0.3  # low-pass added to the screen covariance
MIP_PX2 = 0.1  # that of Mip-Splatting and Brush, for models trained with antialiasing
ALPHA_MAX = float(np.float32(0.99))
ALPHA_MIN = float(np.float32(1.0 / 255.0))
TRANSMITTANCE_STOP = float(np.float32(1.0e-4))
EXTENT_MAX_SIGMA = 3.33  # sqrt(2 ln 255) = 3.3290: outside, even an opaque splat is below ALPHA_MIN
SLOPE_MARGIN = (
    0.3  # the Jacobian's slopes are clamped at this share of the half view beyond the image edge
)
LOG_SCALE_LIMIT = 20.0
TIME_STEPS = 6  # by which the time of a mean's pixel is looked for, from the shutter's middle on


# A camera's numbers, one float32 array.
CAM_FX, CAM_FY, CAM_CX, CAM_CY = range(4)
CAM_SLOPE_LOW_X, CAM_SLOPE_HIGH_X, CAM_SLOPE_LOW_Y, CAM_SLOPE_HIGH_Y = range(4, 8)
CAM_WIDTH = 8
CAM_HEIGHT = 9
# of a rolling shutter: the time of a pixel, in shutters from its middle, as a U + b V + c; and by how
# many pixels things move while it is open, 0: it does not roll
CAM_TIME_U = 10
CAM_TIME_V = 11
CAM_TIME_0 = 12
CAM_REACH = 13

# A node's pose, one float64 array: rotation node to camera, camera centre in the node, the 2D filter
# of its cloud (`GaussianCloud.antialias_px2`) and the depth range.
POSE_ROTATION = 0
POSE_CENTRE = 9
POSE_ANTIALIAS = 12
POSE_NEAR = 13
POSE_FAR = 14
POSE_TURN = 15  # rotation vector and shift of the node as the camera sees it, over the shutter
POSE_SHIFT = 18
POSE_SIZE = 21

# One group of sixteen prepared Gaussians: columns of sixteen lanes each.
GEO_FACTOR = 0  # nine columns: R_q diag(s), row by row
GEO_PEAK = 9  # (log2(opacity) + 4) / 8, see raster_kernels
GEO_EXTENT = 10  # standard deviations out to the alpha cut
GEO_SIZE = 11

# One visible splat: sixteen float32, one cache line. With d = pixel - (u, v) the exponent is s^2 +
# t^2 where s = L11 dx + L12 dy and t = L22 dy: a sum of squares, which keeps its precision for
# needles where the usual quadratic form cancels.
# The radii are half sizes of the box around the drawn ellipse, pixels.
U, V, L11, L12, L22, PEAK, R, G, B, Z, RADIUS_X, RADIUS_Y = range(12)
# s^2 + t^2 of a 4 x 4 block's centre beyond which no pixel of the block is touched
BLOCK_REACH = 15
RECORD = 16  # columns 12 to 14 are empty

TILE = 16  # pixels; a tile is 4 x 4 blocks of 4 x 4 pixels
# Turns (q^2 / 2) log2(e) / 8 into a plain sum of squares
EXPONENT_SCALE = math.sqrt(math.log2(math.e) / 16.0)
