"""Parts by name: what the installed packages register, simrun's own rooms like all others.

A package lists its parts in a module that imports nothing heavy, and names the list in the entry
points ``simrun.parts``. It may also register a single part in the group of its kind
(``simrun.policies``), without a line of help.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.lazy import installed_points
from alpasim_plugin.core.parts.spec import KINDS, KindName

LISTS = "simrun.parts"  # entry points, each a sequence of `RegisteredPart`
# entry points by kind: settings of parts that name none
DEFAULT_SETTINGS = "simrun.default_settings"


@dataclass(frozen=True)
class RegisteredPart:
    """A part that can be named.

    Attributes:
        kind: Its kind.
        name: What users write; ``scheme://`` or ``scheme:`` for parts that an address follows.
        target: ``package.module:attribute`` of its factory.
        help: One line for ``simrun list``.
    """

    kind: KindName
    name: str
    target: str
    help: str

    @property
    def is_shipped(self) -> bool:
        """Tell whether it is one of simrun's own."""
        return self.target.partition(".")[0] in OWN_PACKAGES

    @property
    def is_addressed(self) -> bool:
        """Tell whether an address follows its name."""
        return self.name.endswith((":", "://"))


def entries(kind: KindName) -> Mapping[str, RegisteredPart]:
    """Return every registered part of a kind by name: shipped ones first, those with an address
    last among them.

    Raises:
        InputError: Two packages claim one name, or simrun's own lists are missing.
    """
    parts: dict[str, RegisteredPart] = {}
    for part in _registered(installed_points(LISTS), kind):
        _add(parts, part)
    for point in installed_points(KINDS[kind].group):
        _add(parts, RegisteredPart(kind, point.name, point.value, f"from {point.value}"))
    in_order = sorted(parts.values(), key=lambda part: (not part.is_shipped, part.is_addressed))
    return {part.name: part for part in in_order}


def _add(parts: dict[str, RegisteredPart], part: RegisteredPart) -> None:
    other = parts.setdefault(part.name, part)
    if other.target == part.target:
        return
    kept, refused = (other, part) if other.is_shipped else (part, other)
    raise InputError(
        f"entry point {refused.name!r} = {refused.target!r}: the name is taken by {kept.target}",
        "uninstall one of the two packages or rename its entry point",
    )


@cache
def _registered(points: tuple[EntryPoint, ...], kind: KindName) -> tuple[RegisteredPart, ...]:
    """Return the listed parts of a kind, in the order of the lists.

    Raises:
        InputError: The installed metadata is older than this code.
    """
    if not any(point.value.partition(".")[0] in OWN_PACKAGES for point in points):
        raise InputError(
            "simrun's own parts are not registered: its installation is older than its code",
            "install it again: pip install -e . in its folder, or pip install --force-reinstall of its wheel",
        )
    return tuple(part for point in points for part in point.load() if part.kind == kind)


def default_settings(kind: KindName) -> str | None:
    """Return ``package.module:attribute`` of the settings of a part whose factory names none; None
    where such a part takes no settings.
    """
    values = {point.name: point.value for point in installed_points(DEFAULT_SETTINGS)}
    return values.get(kind)
