"""Keep what is computed of the lenses that callers name, up to a number of bytes."""

import hashlib
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from alpasim_plugin.log.wire import sensorsim_pb2

T = TypeVar("T")
LENS_BYTES = 512 << 20
ENTRY_BYTES = 64 << 10  # that a value counts beside its arrays, so that their number has an end


class LensCache:
    """Values by lens, the oldest going first; one is made at a time, since that of a large image
    takes a gigabyte for some seconds.

    Args:
        most_bytes: Of the arrays in all values; the newest value is kept in any case.
    """

    def __init__(self, most_bytes: int = LENS_BYTES) -> None:
        self._most_bytes = most_bytes
        self._kept: dict[bytes, Any] = {}
        self._making = threading.RLock()  # making one value may need another

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def held(self) -> int:
        """Give the bytes of all values."""
        return sum(ENTRY_BYTES + size_of(value) for value in self._kept.values())

    def get(self, spec: sensorsim_pb2.CameraSpec, variant: object, make: Callable[[], T]) -> T:
        """Return a value of a lens, made if it is not kept.

        Args:
            spec: The lens, as a request names it.
            variant: Which value, and for what size.
            make: Makes it.
        """
        whole = spec.SerializeToString(deterministic=True) + repr(variant).encode()
        key = hashlib.blake2b(whole, digest_size=16).digest()
        value: T | None = self._kept.get(key)
        if value is None:
            with self._making:
                value = self._kept.get(key)
                if value is None:
                    value = self._kept[key] = make()
                    while self.held > self._most_bytes and len(self._kept) > 1:
                        del self._kept[next(iter(self._kept))]
        return value


def size_of(value: Any) -> int:
    """Return the bytes that arrays and tensors in a value hold."""
    if hasattr(value, "element_size"):
        return int(value.numel() * value.element_size())
    if hasattr(value, "nbytes"):
        return int(value.nbytes)
    if isinstance(value, tuple):
        return sum(size_of(part) for part in value)
    if hasattr(value, "__dataclass_fields__"):
        return sum(
            size_of(part) for part in vars(value).values()
        )  # what was computed since as well
    return 0


lenses = LensCache()
