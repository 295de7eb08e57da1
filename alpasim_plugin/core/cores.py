"""How many processor cores this process may use: those that it may run on, and no more than its
container is given time for.
"""

import os
from collections.abc import Iterator
from pathlib import Path

GROUPS = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")
CONTROLLER = "cpu"  # of version 1


def usable_cores(groups: Path = GROUPS, own_groups: Path = OWN_GROUPS) -> int:
    """Return the cores that this process may use, at least one.

    Args:
        groups: Where the system shows control groups, of version 1 or 2.
        own_groups: Lists the groups of this process.
    """
    cores = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    shares = [int(share) for share in _shares(groups, own_groups)]
    return max(1, min([cores, *shares]))


def _shares(groups: Path, own_groups: Path) -> Iterator[float]:
    """Yield how many cores' time each control group of this process has, where it is limited."""
    for line in system_lines(own_groups):
        _, controllers, place = line.split(":", 2)
        is_second_version = controllers == ""
        if not is_second_version and CONTROLLER not in controllers.split(","):
            continue
        root = groups if is_second_version else _mounted(groups, controllers)
        inner = root / place.lstrip("/")
        # Within a container the path may be that of the host, and the root is the container's own.
        folders = [root, *(folder for folder in (inner, *inner.parents) if root in folder.parents)]
        for folder in folders:
            words = _words(folder, is_second_version)
            if len(words) == 2 and words[0].isdigit() and words[1].isdigit():
                yield int(words[0]) / max(int(words[1]), 1)


def _mounted(groups: Path, controllers: str) -> Path:
    """Return the folder of controllers that share a hierarchy, whose order in its name may differ."""
    names = controllers.split(",")
    spellings = (controllers, ",".join(reversed(names)), CONTROLLER)
    folders = [groups / spelling for spelling in spellings]
    return next((folder for folder in folders if os.path.isdir(folder)), folders[0])


def _words(folder: Path, is_second_version: bool) -> list[str]:
    """Return quota and period of a group, in microseconds; another word for no limit."""
    names = ("cpu.max",) if is_second_version else ("cpu.cfs_quota_us", "cpu.cfs_period_us")
    return " ".join(line for name in names for line in system_lines(folder / name)).split()


def system_lines(path: Path) -> list[str]:
    """Return the lines of a file that the system makes; none where it is not there."""
    try:
        with path.open(encoding="utf-8", errors="replace") as stream:
            return stream.read().splitlines()
    except OSError:
        return []
