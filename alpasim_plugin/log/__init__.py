"""Rollout logs: AlpaSim's ASL format, camera images, videos and our own side facts."""

from typing import TYPE_CHECKING

from alpasim_plugin.core.lazy import lazy_names

if TYPE_CHECKING:
    from alpasim_plugin.log.images import decode_image as decode_image
    from alpasim_plugin.log.images import encode_image as encode_image
    from alpasim_plugin.log.reader import read_asl as read_asl
    from alpasim_plugin.log.schema import RolloutHeader as RolloutHeader
    from alpasim_plugin.log.trace import read_facts as read_facts
    from alpasim_plugin.log.trace import write_facts as write_facts
    from alpasim_plugin.log.video import read_mp4 as read_mp4
    from alpasim_plugin.log.video import write_mp4 as write_mp4
    from alpasim_plugin.log.writer import AslWriter as AslWriter

__all__ = [
    "AslWriter",
    "RolloutHeader",
    "decode_image",
    "encode_image",
    "read_asl",
    "read_facts",
    "read_mp4",
    "write_facts",
    "write_mp4",
]

__getattr__ = lazy_names(
    __name__,
    {
        "AslWriter": ".writer",
        "RolloutHeader": ".schema",
        "decode_image": ".images",
        "encode_image": ".images",
        "read_asl": ".reader",
        "read_facts": ".trace",
        "read_mp4": ".video",
        "write_facts": ".trace",
        "write_mp4": ".video",
    },
)
