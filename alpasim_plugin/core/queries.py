"""Options behind a question mark, as in ``HOST:PORT?timeout_s=5``."""

from collections.abc import Collection
from urllib.parse import parse_qsl

from alpasim_plugin.core.errors import InputError


def options_of(query: str, names: Collection[str], text: str) -> dict[str, str]:
    """Return the options of a query ``NAME=VALUE&...``.

    Args:
        query: What follows the question mark.
        names: Names that may be given.
        text: The whole text, for the error.

    Raises:
        InputError: An option has another name.
    """
    options = dict(parse_qsl(query, keep_blank_values=True))
    for name in options:
        if name not in names:
            raise InputError(
                f"{text}: no option {name!r}", f"Use only {', '.join(names) or 'the address'}."
            )
    return options
