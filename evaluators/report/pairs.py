"""The tables of paired differences in a summary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def pair_tables(summary: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any]]]:
    """List the tables of paired differences with the variant of each: against the baseline, then fixers against their base."""
    return [(variant, pairs) for key in ("paired", "paired_with_base") for variant, pairs in (summary.get(key) or {}).items() if pairs]
