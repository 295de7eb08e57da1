"""The name of a rollout: a UUID that sorts as its seed."""

from __future__ import annotations

import hashlib
import uuid

SEED_BITS, DIGEST_BITS = 64, 58


def session_uuid(seed: int, identity: str) -> str:
    """Return the session id of a rollout, a UUID of version 8 (RFC 9562, section 5.8).

    AlpaSim pairs the rollouts of different scenes by the rank of their ids, so an id begins with the seed: rollouts of one seed have the
    same rank in every scene. The rest is a digest, so that ids differ between renderers, policies and scenes.

    Args:
        seed: The rollout's seed, 0 to 2^64 - 1.
        identity: Whatever determines the rollout; equal rollouts have equal ids.

    Example:
        >>> session_uuid(2, "a"), session_uuid(10, "a")
        ('00000000-0000-8000-8b2a-5e044b286ef7', '00000000-0000-8000-ab2a-5e044b286ef7')
    """
    digest = int.from_bytes(hashlib.sha256(identity.encode()).digest()) >> (256 - DIGEST_BITS)
    # Layout: 48 bits, version 8, 12 bits, variant 0b10, 62 bits; the seed's 64 bits come first among the free ones.
    high, middle, low = seed >> 16, (seed >> 4) & 0xFFF, seed & 0xF
    return str(uuid.UUID(int=(high << 80) | (8 << 76) | (middle << 64) | (0b10 << 62) | (low << DIGEST_BITS) | digest))
