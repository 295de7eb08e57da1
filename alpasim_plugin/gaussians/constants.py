"""Constants of the splatting rule, shared by every backend.

Values are those of gsplat 1.6. Thresholds that decide what is drawn are the *float32* neighbours of their decimal value, also in float64
code: whether a second saturated layer is drawn hangs on ``(1 - 0.99)**2 <= 1e-4``, which is true in float32 and false in float64.
"""

from __future__ import annotations

import numpy as np

NEAR_M = 0.1  # a 5 cm splat closer than this smears over the whole frame
FAR_M = 1.0e10
EPS2D_PX2 = 0.3  # low-pass added to the screen covariance
ALPHA_MAX = float(np.float32(0.99))
ALPHA_MIN = float(np.float32(1.0 / 255.0))
TRANSMITTANCE_STOP = float(np.float32(1.0e-4))
EXTENT_MAX_SIGMA = 3.33  # sqrt(2 ln 255) = 3.3290: outside, even an opaque splat is below ALPHA_MIN
SLOPE_MARGIN = 0.3  # the Jacobian's slopes are clamped at this share of the half view beyond the image edge
LOG_SCALE_LIMIT = 20.0
