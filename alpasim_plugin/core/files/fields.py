"""The fields of a file format that a reader knows, as data: those that it reads, those that it may
leave out without a change of the result, and by them the names of all others that a file has.

A field is named by what holds it: ``lane/width`` is an element or a member, ``lane@level`` an
attribute or a tag of its own.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from xml.etree.ElementTree import Element

MOST_NAMED = 12  # fields of one file that a note names


@dataclass(frozen=True)
class Fields:
    """What a reader knows of a format.

    Attributes:
        form: Name of the format.
        read: Holder to the fields in it that are read, separated by spaces; ``@`` begins the name
            of an attribute.
        harmless: The same for fields that change nothing of the result; what they hold is not
            looked at.
    """

    form: str
    read: Mapping[str, str]
    harmless: Mapping[str, str]

    def names(self, harmless: bool = False) -> frozenset[str]:
        """Return the names of the fields that are read, or of those that are harmless."""
        listed = self.harmless if harmless else self.read
        return frozenset(
            field_name(holder, field) for holder, text in listed.items() for field in text.split()
        )

    def notes(self, met: Iterable[str]) -> tuple[str, ...]:
        """Return a note that names the fields of a file which are neither read nor harmless.

        Args:
            met: Names of fields, once for each time that a file has them.
        """
        expected_names = self.names() | self.names(harmless=True)
        unread = Counter(name for name in met if name not in expected_names)
        if not unread:
            return ()
        frequent = sorted(unread, key=lambda name: (-unread[name], name))
        listed = ", ".join(f"{name} ({unread[name]})" for name in frequent[:MOST_NAMED])
        more = len(frequent) - MOST_NAMED
        return (f"{self.form}: not read are {listed}" + (f" and {more} more" if more > 0 else ""),)

    def notes_of_xml(self, root: Element) -> tuple[str, ...]:
        """Return `notes` on an XML document; what stands in an element that is not read is not
        named on its own.
        """
        return self.notes(self._met_below(root, self.names()))

    def row(self) -> tuple[str, str, str]:
        """Return the row of the format in the table of docs/formats.md."""
        return self.form, _listed(self.read), _listed(self.harmless)

    def _met_below(self, element: Element, read: frozenset[str]) -> Iterator[str]:
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


def _listed(fields: Mapping[str, str]) -> str:
    parts = [f"`{holder}`: {' '.join(sorted(text.split()))}" for holder, text in fields.items()]
    return "; ".join(parts)
