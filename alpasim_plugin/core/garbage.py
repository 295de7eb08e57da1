"""How often Python looks for objects that only hold one another."""

import gc

OBJECTS = 20_000  # made and not yet freed; Python's own 700 are few beside a million that stay


def collect_seldom() -> None:
    """Let this process look for cycles after every `OBJECTS` new objects: loading libraries makes a
    million that stay, and each is looked at again and again.
    """
    _, middle, old = gc.get_threshold()
    gc.set_threshold(OBJECTS, middle, old)
