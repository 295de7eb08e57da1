"""A folder whose process was killed while it was being replaced."""

import signal
import subprocess
import sys
from pathlib import Path

KILLED = """
import os, signal, sys
from pathlib import Path
from alpasim_plugin.core.files import atomic

rename = Path.replace

def replace(self, target):
    rename(self, target)
    os.kill(os.getpid(), signal.SIGKILL)

Path.replace = replace
atomic._change_places = lambda first, second: False  # as on file systems that cannot
with atomic.atomic_folder(Path(sys.argv[1])) as partial:
    (partial / "x").write_text("new")
"""


def kill_between_renames(folder: Path) -> None:
    """Let another process begin to replace a folder, and kill it when the old one is out of the way."""
    words = [sys.executable, "-c", KILLED, str(folder)]
    assert subprocess.run(words, check=False).returncode == -signal.SIGKILL
    assert not folder.exists()
