"""Rollout logs: AlpaSim's ASL format, camera images, videos and our own side facts."""

from alpasim_plugin.log.facts import read_facts, write_facts
from alpasim_plugin.log.images import decode_image, encode_image
from alpasim_plugin.log.reader import read_asl
from alpasim_plugin.log.schema import RolloutHeader, header_from_scenario
from alpasim_plugin.log.video import read_mp4, write_mp4
from alpasim_plugin.log.writer import AslWriter

__all__ = [
    "AslWriter",
    "RolloutHeader",
    "decode_image",
    "encode_image",
    "header_from_scenario",
    "read_asl",
    "read_facts",
    "read_mp4",
    "write_facts",
    "write_mp4",
]
