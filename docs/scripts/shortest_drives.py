"""Scenes of the record docs/experiments/scale.md: `python docs/scripts/shortest_drives.py FOLDER`
writes FOLDER/suite500.yaml.

Five hundred scenes of a straight street, one for each scene seed.
"""

from __future__ import annotations

import sys
from pathlib import Path

STREET = """version: 1
description: Two-lane street, straight ahead, nobody else.
road:
  segments:
    - {kind: straight, length_m: 220}
ego: {speed_mps: 10, cruise_mps: 10}
timing: {duration_us: 7_000_000}
"""

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "street.yaml").write_text(STREET)
    suite = f"version: 1\ndescription: Five hundred scenes.\nscenarios:\n  - {{path: street.yaml, seeds: {list(range(500))}}}\n"
    (folder / "suite500.yaml").write_text(suite)
