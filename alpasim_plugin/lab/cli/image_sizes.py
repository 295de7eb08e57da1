"""Sizes of images on the command line."""

from __future__ import annotations

from alpasim_plugin.core.errors import InputError


def parse_size(text: str, option: str = "--size", multiple: int = 1) -> tuple[int, int]:
    """Return width and height, pixels.

    Args:
        text: ``WIDTHxHEIGHT``.
        option: That it was given with, for the error.
        multiple: That both have to be multiples of.

    Example:
        >>> parse_size("256x144")
        (256, 144)

    Raises:
        InputError: Anything but two positive multiples of ``multiple``.
    """
    sides = [int(part) if part.strip().isdecimal() else 0 for part in text.lower().split("x")]
    if len(sides) != 2 or any(side < 1 or side % multiple for side in sides):
        raise InputError(
            f"{option} {text}: not two positive {f'multiples of {multiple}' if multiple > 1 else 'integers'}",
            "write WIDTHxHEIGHT, such as 256x144",
        )
    return sides[0], sides[1]
