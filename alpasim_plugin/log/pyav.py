"""PyAV, loaded where a video is read or written and nowhere else: AlpaSim's environment leaves it out."""

from __future__ import annotations

from typing import Any

from alpasim_plugin.core.errors import InfrastructureError


def load_av(doing: str) -> Any:
    """Return the module ``av``.

    Args:
        doing: For the message.

    Raises:
        InfrastructureError: It is not installed, or does not load.
    """
    try:
        import av
        import av.video.reformatter
    except ImportError as missing:
        raise InfrastructureError(doing, "PyAV", f"it does not load ({missing})", 'pip install "av>=14"') from missing
    return av


def exact_conversion(av: Any) -> Any:
    """Return the scaler's settings for colour conversion. Its faster ones darken pictures by a grey level; these are exact to a tenth."""
    flags = av.video.reformatter.Interpolation
    return flags.BILINEAR | flags.ACCURATE_RND | flags.FULL_CHR_H_INP | flags.FULL_CHR_H_INT
