"""A small deterministic mutator: the same seed gives the same damage."""

from __future__ import annotations

import copy
import json
import random
import re
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import yaml

NUMBERS = (
    "0",
    "-1",
    "1",
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e-308",
    "1e9",
    "-1e9",
    "1e5",
    "999999999999",
    "9223372036854775808",
    "-9223372036854775809",
    "18446744073709551616",
    "0.0000001",
    "4300000000",
    "1" * 5000,
    "",
)
VALUES: tuple[Any, ...] = (
    0,
    -1,
    1,
    1e308,
    -1e308,
    1e-308,
    1e9,
    1e6,
    float("nan"),
    float("inf"),
    2**63,
    -(2**63) - 1,
    2**64,
    10**30,
    "",
    "x" * 5000,
    "nan",
    None,
    True,
    [],
    {},
    [1],
    [[]],
    {"a": 1},
    "../../../etc/passwd",
    "/dev/zero",
    "\x1b[31m\x00|`<b>&\u202e",
    [1, "a", None],
    "\ud800",
    "12:30",
)
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
WORD = re.compile(rb"[A-Za-z_]{2,}")


def mutate(data: bytes, form: str, rng: random.Random) -> bytes:
    """Return damaged data.

    Args:
        data: A valid document.
        form: json, yaml, xml, text or binary: what structure the mutator may use.
        rng: Where chance comes from.
    """
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        aware = STRUCTURED.get(form)
        choice = rng.random()
        if aware is not None and choice < 0.65:
            data = aware(data, rng)
        elif form != "binary" and choice < 0.85:
            data = _text(data, rng)
        else:
            data = _bytes(data, rng)
    return data


def _bytes(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    if not out:
        return rng.randbytes(8)
    at = rng.randrange(len(out))
    if rng.random() < 0.4:
        at = rng.randrange(min(len(out), 256))  # headers decide more than bodies
    match rng.randrange(7):
        case 0:
            out[at] ^= 1 << rng.randrange(8)
        case 1:
            return bytes(out[:at])
        case 2:
            out[at:at] = rng.randbytes(rng.choice((1, 4, 64)))
        case 3:
            size = rng.choice((1, 2, 4, 8))
            extreme = rng.choice(
                (
                    0,
                    1,
                    (1 << 8 * size) - 1,
                    1 << (8 * size - 1),
                    (1 << (8 * size - 1)) - 1,
                    100_000_000 % (1 << 8 * size),
                )
            )
            out[at : at + size] = extreme.to_bytes(size, rng.choice(("little", "big")))
        case 4:
            del out[at : at + rng.choice((1, 4, 64, 1024))]
        case 5:
            end = min(len(out), at + rng.choice((4, 64, 512)))
            out[at:at] = out[at:end]
        case 6:
            end = min(len(out), at + rng.choice((4, 16, 256)))
            out[at:end] = rng.choice((b"\0", b"\xff")) * (end - at)
    return bytes(out)


def _text(data: bytes, rng: random.Random) -> bytes:
    kind = rng.randrange(5)
    if kind <= 1:
        found = list(NUMBER.finditer(data))
        if found:
            one = rng.choice(found)
            return data[: one.start()] + rng.choice(NUMBERS).encode() + data[one.end() :]
    if kind == 2:
        words = list(WORD.finditer(data))
        if len(words) > 1:
            one, other = rng.choice(words), rng.choice(words)
            return data[: one.start()] + other[0] + data[one.end() :]
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    if kind == 3:
        return b"\n".join(lines[:at] + lines[at + 1 :])
    times = rng.choice((1, 2, 50))
    return b"\n".join(lines[:at] + lines[at : at + 1] * times + lines[at:])


def _paths(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    out = [path]
    inside = (
        node.items()
        if isinstance(node, dict)
        else enumerate(node[:40])
        if isinstance(node, list)
        else ()
    )
    for key, child in inside:
        out += _paths(child, (*path, key))
    return out


def damaged(document: Any, rng: random.Random) -> Any:
    """Return plain data with one value replaced, removed, repeated or nested deeply."""
    document = copy.deepcopy(document)
    path = rng.choice(_paths(document))
    if not path:
        return rng.choice(VALUES)
    owner = document
    for key in path[:-1]:
        owner = owner[key]
    key, kind = path[-1], rng.randrange(8)
    if kind <= 4:
        owner[key] = rng.choice(VALUES)
    elif kind == 5:
        del owner[key]
    elif kind == 6:
        value = owner[key]
        for _ in range(rng.choice((3, 60, 300))):
            value = [value]
        owner[key] = value
    elif isinstance(owner, list):
        owner[key:key] = [owner[key]] * rng.choice((1, 2, 30))
    else:
        owner[f"{key}_"] = owner[key]
    return document


def _json(data: bytes, rng: random.Random) -> bytes:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return _text(data, rng)
    return json.dumps(damaged(document, rng)).encode()


def _yaml(data: bytes, rng: random.Random) -> bytes:
    try:
        document = yaml.safe_load(data)
        return yaml.safe_dump(damaged(document, rng), sort_keys=False, allow_unicode=True).encode(
            "utf-8", "surrogatepass"
        )
    except (yaml.YAMLError, ValueError, RecursionError):
        return _text(data, rng)


def _xml(data: bytes, rng: random.Random) -> bytes:
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError):
        return _text(data, rng)
    parents = [e for e in root.iter() if len(e)]
    everyone = list(root.iter())
    one = rng.choice(everyone)
    match rng.randrange(5):
        case 0 if parents:
            owner = rng.choice(parents)
            owner.remove(rng.choice(list(owner)))
        case 1 if parents:
            owner = rng.choice(parents)
            child = rng.choice(list(owner))
            for _ in range(rng.choice((1, 2, 40))):
                owner.append(copy.deepcopy(child))
        case 2 if one.attrib:
            one.set(rng.choice(list(one.attrib)), rng.choice(NUMBERS))
        case 3 if one.attrib:
            del one.attrib[rng.choice(list(one.attrib))]
        case _:
            one.text = rng.choice(NUMBERS)
    return ElementTree.tostring(root)


STRUCTURED: dict[str, Callable[[bytes, random.Random], bytes]] = {
    "json": _json,
    "yaml": _yaml,
    "xml": _xml,
}
