"""The type of what is read from and written to JSON."""

from __future__ import annotations

from typing import Any

JsonObject = dict[str, Any]  # an object of a document, by its keys
