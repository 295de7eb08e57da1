"""One bound per quantity: its name, unit, range, and why. Every reader and schema takes its limits from here.

docs/security.md shows this table; a test holds the two together.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Bound:
    """The range of one quantity, both ends allowed."""

    name: str
    unit: str
    low: float
    high: float
    reason: str


KIB, MIB, GIB = 1 << 10, 1 << 20, 1 << 30

FILE_BYTES = Bound("file size", "bytes", 0, 2 * GIB, "no scene, log or table that this machine could use is larger")
JSON_BYTES = Bound("JSON size", "bytes", 0, 256 * MIB, "parsed JSON takes about ten times its size in memory")
DEPTH = Bound("depth of nesting", "levels", 0, 64, "no format here nests deeper than a dozen levels")
