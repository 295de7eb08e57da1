"""Required and optional members of a part: what it must have, and the defaults of what it may have. No package is needed for it."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from types import MethodType
from typing import Any, TypeVar

from alpasim_plugin.core.errors import InputError, PolicyError, SimrunError

T = TypeVar("T")


def complete(part: T, interface: Any, what: str = "") -> T:
    """Return a part with the defaults of the optional members that it does not define.

    Args:
        part: Any object with the interface's required members; it need not inherit from the interface.
        interface: Of `alpasim_plugin.plugins.interfaces`.
        what: The part for messages.

    Raises:
        InputError: A required member is missing; of a policy it is a `PolicyError`, since only the loop finds it out.
    """
    required, optional = _members(interface)
    missing = [name for name in required if not hasattr(part, name)]
    if missing:
        kind = interface.__name__.lower()
        raise misfit(kind)(
            f"making a {kind}",
            what or type(part).__name__,
            f"a {type(part).__name__} without {', '.join(missing)}",
            f"give it {', '.join(f'`{name}`' for name in required)}; docs/extending.md shows a {kind}",
        )
    for name, default in optional.items():
        if not hasattr(part, name):
            value = dict(default) if isinstance(default, Mapping) else default
            setattr(part, name, MethodType(value, part) if inspect.isfunction(value) else value)
    return part


def misfit(kind: str) -> type[SimrunError]:
    """Return the error of a part that does not have its kind's form: a policy is what is under test, so the fault is its own."""
    return PolicyError if kind == "policy" else InputError


def _members(interface: Any) -> tuple[list[str], dict[str, Any]]:
    """Return the names of the required members, and the optional ones with their defaults."""
    own = vars(interface)
    required = [name for name in interface.__annotations__ if name not in own]
    required += [name for name, member in own.items() if getattr(member, "__isabstractmethod__", False)]
    optional = {name: own[name] for name in interface.__annotations__ if name in own}
    public = {name: member for name, member in own.items() if inspect.isfunction(member) and not name.startswith("_")}
    return required, optional | {name: member for name, member in public.items() if name not in required}
