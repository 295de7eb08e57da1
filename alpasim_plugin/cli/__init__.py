"""The command line: one file a verb, or for verbs of one job."""

import os

# Threads of torch's OpenMP (libgomp) spin for milliseconds before they sleep, and so take the core
# from the thread that they wait for where other work shares it. Ten thousand turns are some
# microseconds (docs/experiments/speed.md). It is read once.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
