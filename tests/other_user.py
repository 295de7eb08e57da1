"""Run a command as another user, in a file system of its own: without rights to the source, with a
read-only root, or with a small disk.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

NOBODY = 65534
TOOLS = ("unshare", "setpriv", "mount")
REPO = Path(__file__).resolve().parents[1]


def can_become_nobody():
    """Tell whether this process may change its user and mount, in a file system of its own."""
    if os.getuid() != 0 or any(shutil.which(tool) is None for tool in TOOLS):
        return False
    return (
        subprocess.run(
            ["unshare", "-m", "mount", "-t", "tmpfs", "none", "/mnt"],
            capture_output=True,
            check=False,
        ).returncode
        == 0
    )


def is_open(path):
    """Tell whether every user may read a file, or list and enter a folder."""
    wanted = 0o005 if path.is_dir() else 0o004
    return path.stat().st_mode & wanted == wanted


as_root = pytest.mark.skipif(
    not can_become_nobody() or not is_open(Path(__file__)),
    reason="needs root that may mount, to become another user, and a checkout whose files every "
    "user may read",
)


@contextmanager
def shared_folder():
    """Give a folder that every user may write."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o777)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def outermost_closed(path):
    """Return the first folder on the way to a path, or itself, that other users may not enter."""
    return next((folder for folder in (*reversed(path.parents), path) if not is_open(folder)), None)


def distinct(*folders):
    """Return the folders that lie in no other of them."""
    return [folder for folder in dict.fromkeys(folders) if not set(folder.parents) & set(folders)]


def lines_that_open(folders):
    """Return lines of shell that let every user reach folders below some that only root may enter,
    such as a clone in root's home: what these hold is mounted again below an empty folder that all
    may enter. A folder that is closed itself is mounted piece by piece.
    """
    keep = ["mount -t tmpfs -o mode=755 none /mnt"]
    cover = []
    move = []
    for folder in folders:
        closed = outermost_closed(folder)
        if closed is None:
            continue
        pieces = [folder] if is_open(folder) else sorted(folder.iterdir())
        for piece in pieces:
            kept = f"/mnt/{len(move)}"
            make, parent = ("mkdir -p", piece) if piece.is_dir() else ("touch", piece.parent)
            keep.append(f'{make} {kept} && mount --bind "{piece}" {kept}')
            move.append(f'mkdir -p "{parent}" && {make} "{piece}" && mount --move {kept} "{piece}"')
        line = f'mount -t tmpfs -o mode=755 none "{closed}"'
        if line not in cover:
            cover.append(line)
    return "".join(f"{line}\n" for line in (*keep, *cover, *move)) if move else ""


def run_as_nobody(
    command,
    *,
    cwd="/",
    mounts="",
    timeout=240,
    **variables,
):
    """Run a command as the user "nobody".

    Args:
        command: Program and arguments.
        cwd: Its working directory.
        mounts: Lines of shell that root runs before, in a file system that only the command sees.
        timeout: Seconds.
        variables: Its environment, beside PATH.
    """
    show = lines_that_open(distinct(Path(sys.base_prefix), Path(sys.prefix), REPO))
    become = f'exec setpriv --reuid={NOBODY} --regid={NOBODY} --clear-groups --no-new-privs --bounding-set=-all -- "$@"\n'
    script = f'set -e\n{show}{mounts}cd "{cwd}"\n{become}'
    environment = {"PATH": os.environ["PATH"], "LANG": "C.UTF-8", **variables}
    whole = ["unshare", "-m", "sh", "-c", script, "sh", *command]
    return subprocess.run(
        whole, env=environment, capture_output=True, text=True, check=False, timeout=timeout
    )
