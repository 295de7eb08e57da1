"""What a reader must know of the plans of a run: those that no vehicle could drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def plan_warnings(summary: Mapping[str, Any]) -> list[str]:
    """Say in one sentence each whose plans do not fit the vehicle; variants with the same sentence share it."""
    by_text: dict[str, list[str]] = {}
    for name, entry in (summary.get("plans") or {}).items():
        if entry.get("warning"):
            by_text.setdefault(str(entry["warning"]), []).append(name)
    return [f"{', '.join(names)}: {text} (simrun check-policy tests units)" for text, names in by_text.items()]
