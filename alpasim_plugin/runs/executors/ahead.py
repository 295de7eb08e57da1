"""Load what most rollouts need, kernels too where they are compiled: imported by the process that
workers are copies of.

None of it starts a thread but that of an allocator, which forks well. What is missing here is
loaded by each worker.
"""

from __future__ import annotations

import gc
from importlib import import_module

import cv2
import numpy as np

from alpasim_plugin.core.lazy import arrow_without_pandas

NEEDED = (
    "alpasim_plugin.control.tracker",
    "alpasim_plugin.renderers.gaussian",
    "alpasim_plugin.runs.execute",
    "evaluators.metrics.image_health",
    "evaluators.metrics.motion",
    "evaluators.metrics.offroad",
    "evaluators.metrics.outcomes",
    "evaluators.metrics.plan",
    "policies.lane_camera",
    "pyarrow.dataset",
)


def load() -> None:
    """Load it, and keep the collector from looking through what stays: no copy then writes to the
    memory that they share.
    """
    gc.disable()
    with arrow_without_pandas():
        for name in NEEDED:
            import_module(name)
    from alpasim_plugin.core import kernels
    from alpasim_plugin.runs.execute import is_cold

    if not is_cold("rasteriser"):
        kernels.call("rasteriser")
    cv2.setNumThreads(1)  # no threads of its own, which a copy would not have
    cv2.cvtColor(
        np.zeros((1, 1, 3), np.uint8), cv2.COLOR_RGB2Lab
    )  # the first conversion computes tables for 0.07 s
    gc.freeze()
    gc.enable()


load()
