"""Options behind a question mark, as in ``HOST:PORT?timeout_s=5``."""

from collections.abc import Collection
from urllib.parse import parse_qsl

from alpasim_plugin.core.errors import InputError


def options_of(query: str, known: Collection[str], where: str) -> dict[str, str]:
    """Return the options of a query ``NAME=VALUE&...``.

    Args:
        query: What follows the question mark.
        known: Names that may be given.
        where: The whole text, for the error.

    Raises:
        InputError: An option has another name.
    """
    given = dict(parse_qsl(query, keep_blank_values=True))
    for name in given:
        if name not in known:
            raise InputError(
                f"{where}: no option {name!r}", f"Use only {', '.join(known) or 'the address'}."
            )
    return given
