"""The fields of a file format that a reader knows, as data: those that it reads, those that it may
leave out without a change of the result, those that it refuses, and by them the names of all others
that a file has.

A field is named by what holds it: ``lane/width`` is an element or a member, ``lane@level`` an
attribute or a tag of its own.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.reading import some_of

MOST_NAMED = 12  # fields of one file that a note names
NUMBER = "#"  # stands for any number in the name of a field


@dataclass(frozen=True)
class Fields:
    """What a reader knows of a format.

    Attributes:
        form: Name of the format.
        read: Holder to the fields in it that are read, separated by spaces; ``@`` begins the name
            of an attribute.
        harmless: The same for fields that change nothing of the result; what they hold is not
            looked at.
        moving: The same for fields that change the result and are not applied: a file that has such
            a field is refused.
        others: What becomes of a field that is in none of these lists: a note names it, or the file
            is refused.
    """

    form: str
    read: Mapping[str, str]
    harmless: Mapping[str, str]
    moving: Mapping[str, str] = field(default_factory=dict)
    others: Literal["named", "refused"] = "named"

    def names(self, harmless: bool = False) -> frozenset[str]:
        """Return the names of the fields that are read, or of those that are harmless."""
        return _names(self.harmless if harmless else self.read)

    def notes(self, met: Iterable[str]) -> tuple[str, ...]:
        """Return a note that names the fields of a file which are neither read nor harmless.

        Args:
            met: Names of fields, once for each time that a file has them.
        """
        unread = Counter(name for name in met if not self._expected.fullmatch(name))
        if not unread:
            return ()
        frequent = sorted(unread, key=lambda name: (-unread[name], name))
        listed = [f"{name} ({unread[name]})" for name in frequent]
        return (f"{self.form}: not read are {some_of(listed, MOST_NAMED)}",)

    def notes_of_xml(self, root: Element) -> tuple[str, ...]:
        """Return `notes` on an XML document; what stands in an element that is not read is not
        named on its own.
        """
        return self.notes(self._met_below(root, self.names()))

    def check(self, met: Iterable[str], location: Path | str, do_this: str) -> None:
        """Refuse a file for fields that change the result and are not applied.

        Args:
            met: See `notes`.
            location: The file.
            do_this: What its user can do.

        Raises:
            InputError: A field is in `moving`, or in no list of a format that refuses `others`.
        """
        unread = {name for name in met if not self._expected.fullmatch(name)}
        if self.others == "named":
            unread = {name for name in unread if self._moving.fullmatch(name)}
        if unread:
            raise InputError(
                f"{location}: fields that may change the result and are not read: {some_of(sorted(unread))}",
                do_this,
            )

    def row(self) -> tuple[str, str, str, str]:
        """Return the row of the format in the table of docs/formats.md."""
        refused = _listed(self.moving)
        if self.others == "refused":
            refused = f"{refused}; all others" if refused else "all others"
        return self.form, _listed(self.read), _listed(self.harmless), refused

    @cached_property
    def _expected(self) -> re.Pattern[str]:
        return _pattern(self.names() | self.names(harmless=True))

    @cached_property
    def _moving(self) -> re.Pattern[str]:
        return _pattern(_names(self.moving))

    def _met_below(self, element: Element, read: frozenset[str]) -> Iterator[str]:
        """Give the names of what stands in an element, and in those elements of it that are read."""
        for attribute in element.attrib:
            yield field_name(element.tag, f"@{attribute}")
        for child in element:
            if not isinstance(child.tag, str):  # a comment
                continue
            name = field_name(element.tag, child.tag)
            yield name
            if name in read:
                yield from self._met_below(child, read)


def field_name(holder: str, field: str) -> str:
    """Return the name of a field in its holder."""
    return f"{holder}{field}" if field.startswith("@") else f"{holder}/{field}"


def met_in(holder: str, fields: Iterable[str]) -> list[str]:
    """Return the names of fields that a holder in a file has."""
    return [field_name(holder, name) for name in fields]


def _names(listed: Mapping[str, str]) -> frozenset[str]:
    return frozenset(
        field_name(holder, name) for holder, text in listed.items() for name in text.split()
    )


def _pattern(names: Iterable[str]) -> re.Pattern[str]:
    """Return a pattern of the names, in which a ``#`` stands for any number."""
    escaped = (re.escape(name).replace(re.escape(NUMBER), r"\d+") for name in sorted(names))
    return re.compile("|".join(escaped))


def _listed(fields: Mapping[str, str]) -> str:
    parts = [f"`{holder}`: {' '.join(sorted(text.split()))}" for holder, text in fields.items()]
    return "; ".join(parts)
