"""Values as JSON holds them, and back: typed and exact, so that two values never look the same and one
value never looks like two.

JSON has no number that is infinite or undefined, no sets, no bytes, and text alone as keys. Each of
these is written as an object with one member whose name begins with ``!``.
"""

import json
import math
from collections.abc import Mapping
from enum import Enum
from pathlib import PurePath
from typing import Any

MARK = "!"
FLOAT = "!float"
BYTES = "!bytes"
SET = "!set"
PAIRS = "!pairs"  # of a mapping whose keys are not text


def to_plain(value: Any) -> Any:
    """Return a value as JSON holds it. Tuples become lists, paths and members of enumerations what
    they stand for, numpy's numbers those of Python, pydantic's models objects.

    Raises:
        TypeError: A value of any other kind.

    Example:
        >>> to_plain({"cap_m": float("inf"), "names": {"b", "a"}})
        {'cap_m': {'!float': 'inf'}, 'names': {'!set': ['a', 'b']}}
    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, Enum):
        return to_plain(value.value)
    if isinstance(value, str):
        return str(value)
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else {FLOAT: str(float(value))}
    if isinstance(value, bytes):
        return {BYTES: value.hex()}
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, list | tuple):
        return [to_plain(member) for member in value]
    if isinstance(value, set | frozenset):
        return {SET: sorted((to_plain(member) for member in value), key=json.dumps)}
    if isinstance(value, Mapping):
        return _plain_mapping(value)
    return _plain_object(value)


def _plain_mapping(value: Mapping[Any, Any]) -> Any:
    """Return a mapping as JSON holds it."""
    if not all(isinstance(key, str) for key in value):
        pairs = [[to_plain(key), to_plain(member)] for key, member in value.items()]
        return {PAIRS: sorted(pairs, key=json.dumps)}
    content = {str(key): to_plain(member) for key, member in value.items()}
    is_like_a_mark = len(content) == 1 and next(iter(content)).startswith(MARK)
    return {MARK: content} if is_like_a_mark else content


def _plain_object(value: Any) -> Any:
    """Return a model of pydantic, a number of numpy, or what pydantic can write."""
    if hasattr(value, "model_dump"):
        return to_plain(value.model_dump())
    if hasattr(value, "dtype") and getattr(value, "shape", None) == ():
        return to_plain(value.item())
    from pydantic_core import PydanticSerializationError, to_jsonable_python

    try:
        return to_jsonable_python(value)
    except PydanticSerializationError as error:
        raise TypeError(f"a {type(value).__name__} has no form in JSON") from error


def from_plain(plain: Any) -> Any:
    """Return the value that `to_plain` was given: numbers, text, lists, sets, bytes and mappings.

    Example:
        >>> from_plain({"cap_m": {"!float": "-inf"}, "by_number": {"!pairs": [[1, 2.5]]}})
        {'cap_m': -inf, 'by_number': {1: 2.5}}
    """
    if isinstance(plain, list):
        return [from_plain(member) for member in plain]
    if not isinstance(plain, Mapping):
        return plain
    if len(plain) == 1:
        ((mark, content),) = plain.items()
        if mark == MARK and isinstance(content, Mapping):
            return {key: from_plain(member) for key, member in content.items()}
        if mark == FLOAT:
            return float(content)
        if mark == BYTES:
            return bytes.fromhex(content)
        if mark == SET:
            return {_key(from_plain(member)) for member in content}
        if mark == PAIRS:
            return {_key(from_plain(key)): from_plain(member) for key, member in content}
    return {key: from_plain(member) for key, member in plain.items()}


def _key(value: Any) -> Any:
    """Return a value that may be a key or the member of a set: of a list the tuple."""
    return tuple(map(_key, value)) if isinstance(value, list) else value
