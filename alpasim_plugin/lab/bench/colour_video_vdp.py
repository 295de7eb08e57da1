"""ColorVideoVDP (Mantiuk et al. 2024): how far apart two images look, in units of
    just-objectionable differences; 10 is the same.

The package ``cvvdp`` (MIT) is not a dependency: install it beside (`HOW`). Its parameters ship in
its wheel, so nothing is downloaded and nothing here trained it. The display is its
``standard_fhd``.
"""

from __future__ import annotations

import importlib
import warnings
from typing import Any

import numpy as np

from alpasim_plugin.core.types import F64, U8

DISPLAY = "standard_fhd"
# Its torchvision loads beside the torch that it was built for alone, so the two are best installed
# together.
HOW = "pip install cvvdp in an environment of its own, which then has the torch that its torchvision fits"


class ColourVideoVDP:
    """The metric, loaded once."""

    def __init__(self, package: Any) -> None:
        import torch

        self._metric = package.cvvdp(display_name=DISPLAY, quiet=True, device=torch.device("cpu"))

    def jod(self, made: U8, truth: U8) -> F64:
        """Return the quality ``(T,)`` of images ``(T, H, W, 3)``, each by itself: 10 is no
        visible difference.
        """
        return np.array(
            [
                float(self._metric.predict(a, b, dim_order="HWC")[0])
                for a, b in zip(made, truth, strict=True)
            ]
        )


def load_metric() -> tuple[ColourVideoVDP | None, str]:
    """Return the metric; or None and why there is none: it is not installed, or does not run
    here.
    """
    # Its own dependencies may not fit the torch that is here
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            package = importlib.import_module("pycvvdp")
    except ModuleNotFoundError as error:
        return None, f"cvvdp_jod is not measured: there is no module {error.name!r}; {HOW}"
    except (
        ImportError,
        OSError,
        RuntimeError,
    ) as error:
        return (
            None,
            f"cvvdp_jod is not measured: {type(error).__name__}: {str(error).splitlines()[0]}; {HOW}",
        )
    return ColourVideoVDP(package), ""
