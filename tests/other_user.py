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
# The interpreter may lie in a folder that only root may enter: it is mounted again below an empty
# folder that all may.
SHOW = """
mount -t tmpfs -o mode=755 none /mnt && mkdir /mnt/keep && mount --bind "{prefix}" /mnt/keep
mount -t tmpfs -o mode=755 none "{closed}" && mkdir -p "{prefix}" && mount --move /mnt/keep "{prefix}"
"""


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


as_root = pytest.mark.skipif(
    not can_become_nobody(), reason="needs root that may mount, to become another user"
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


def _closed():
    """Return the first folder on the way to the interpreter that other users may not enter."""
    prefix = Path(sys.base_prefix)
    return next(
        (one for one in reversed((prefix, *prefix.parents)) if not one.stat().st_mode & 0o001), None
    )


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
    closed = _closed()
    show = SHOW.format(prefix=sys.base_prefix, closed=closed) if closed is not None else ""
    become = f'exec setpriv --reuid={NOBODY} --regid={NOBODY} --clear-groups --no-new-privs --bounding-set=-all -- "$@"\n'
    script = f'set -e\n{show}{mounts}cd "{cwd}"\n{become}'
    environment = {"PATH": os.environ["PATH"], "LANG": "C.UTF-8", **variables}
    whole = ["unshare", "-m", "sh", "-c", script, "sh", *command]
    return subprocess.run(
        whole, env=environment, capture_output=True, text=True, check=False, timeout=timeout
    )
