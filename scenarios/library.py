"""The scenarios and suites that come with the package, by name."""

from __future__ import annotations

from pathlib import Path

import yaml

LIBRARY = Path(__file__).resolve().parent


def shipped_names() -> dict[str, Path]:
    """Return the shipped scenarios: name without ending, to file. Suites are not among them."""
    files = (file for file in sorted(LIBRARY.glob("*/*.yaml")) if file.parent.name not in ("suites", "base"))
    return {f"{file.parent.name}/{file.stem}": file for file in files}


def suites() -> dict[str, Path]:
    """Return the shipped suites: ``suites/NAME`` to file."""
    return {f"suites/{file.stem}": file for file in sorted((LIBRARY / "suites").glob("*.yaml"))}


def shipped() -> dict[str, str]:
    """Return every shipped scenario and suite with its one-line description."""
    # The plain loader of libyaml: positions of keys, which messages about other people's files need, take most of a listing's time.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    found = {**shipped_names(), **suites()}
    return {name: str(yaml.load(file.read_text(), loader).get("description", "")) for name, file in found.items()}
