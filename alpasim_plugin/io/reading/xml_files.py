"""XML without entities, with limits on depth and elements."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.limits import DEPTH, XML_ELEMENTS
from alpasim_plugin.io.reading.files import FETCH_AGAIN, parsing


def parse_xml(data: bytes, where: Path | str, doing: str) -> ElementTree.Element:
    """Return the root of an XML document; a DOCTYPE is refused, so no entity can be defined or expanded.

    Raises:
        InputError: Malformed or truncated, a DOCTYPE, an unreadable encoding, or nested deeper or larger than the bounds.
    """
    depth = count = 0

    def refuse(*_: Any) -> None:
        raise InputError(doing, str(where), "a DOCTYPE declaration", "remove it: entities are not accepted in scenario files")

    def begin(*_: Any) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > DEPTH.high:
            raise InputError(doing, str(where), f"nested deeper than {DEPTH.high:.0f} levels", FETCH_AGAIN)
        if count > XML_ELEMENTS.high:
            raise InputError(doing, str(where), f"more than {XML_ELEMENTS.high:.0f} elements", "give a smaller map")

    def end(*_: Any) -> None:
        nonlocal depth
        depth -= 1

    scout = expat.ParserCreate()
    scout.StartDoctypeDeclHandler, scout.StartElementHandler, scout.EndElementHandler = refuse, begin, end
    try:
        with parsing(doing, where, FETCH_AGAIN, "malformed XML"):
            scout.Parse(data, True)
            return ElementTree.fromstring(data)
    except InputError as error:
        if isinstance(error.__cause__, ValueError | LookupError) and not isinstance(error.__cause__, ElementTree.ParseError):
            raise InputError(doing, str(where), f"an unreadable text encoding: {error.__cause__}", "save the file as UTF-8") from error
        raise
