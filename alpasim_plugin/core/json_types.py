"""The type of what is read from and written to JSON."""

from collections.abc import Mapping
from typing import Any

JsonObject = dict[str, Any]  # an object of a document, by its keys
JsonView = Mapping[str, Any]  # one that is only read
