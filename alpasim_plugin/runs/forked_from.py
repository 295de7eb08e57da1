"""Loaded by the process that workers are forked from: it becomes the parent of what a worker that
has died leaves running, so that `alpasim_plugin.core.subprocesses.end_orphans` knows that.
"""

import os
import warnings

from alpasim_plugin.core.subprocesses import adopt_orphans

VARIABLE = "SIMRUN_FORKS_WORKERS"  # set where that process is started, and for no other

if os.environ.pop(VARIABLE, ""):
    adopt_orphans()
    warnings.filterwarnings("ignore", "forkserver: waitpid returned unexpected pid")
