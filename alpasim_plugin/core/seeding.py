"""Random streams keyed by (scene, seed, component, step).

The hashed key seeds a Philox counter-based generator. A stream depends on its key alone: not on
call order, worker count or platform. The renderer's name is not part of the key of a shared
component: all renderers get common random numbers, which reduces the variance of paired
differences. A scene at several values of a parameter keeps its streams: the value in its name is not
part of the key.
"""

import hashlib
import re

import numpy as np

POINT = "@@"  # and a number in the name of a scene: a value of a varied parameter


def derive_seed(scene_id: str, seed: int, component: str, step: int = 0) -> int:
    """Return a 64-bit seed for one component at one step.

    Example:
        >>> derive_seed("straight", 0, "policy") == derive_seed("straight", 0, "policy")
        True
        >>> derive_seed("straight", 0, "policy") == derive_seed("straight", 1, "policy")
        False
    """
    return int.from_bytes(_digest(scene_id, seed, component, step)[:8], "little")


def stream(scene_id: str, seed: int, component: str, step: int = 0) -> np.random.Generator:
    """Return the random generator of one component at one step."""
    key = np.frombuffer(_digest(scene_id, seed, component, step)[:16], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key))


def _digest(scene_id: str, seed: int, component: str, step: int) -> bytes:
    scene = re.sub(POINT + r"-?[0-9.]+(e[-+]?[0-9]+)?", "", scene_id)
    text = f"{scene}\x1f{int(seed)}\x1f{component}\x1f{int(step)}"
    return hashlib.blake2b(text.encode(), digest_size=32).digest()
