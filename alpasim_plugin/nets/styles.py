"""The appearances of a scene: what the style judge tells apart, and what a fixer with learned prompts can be asked for."""

from __future__ import annotations

CLEAR = "clear"  # the appearance of the render: the identity
STYLES = (CLEAR, "night", "fog", "snow")
