"""Make a folder that a test wrote or changed by hand into one that a run wrote: with checksums and
contents.
"""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq

from alpasim_plugin.core.checksums import SEAL
from alpasim_plugin.log.run_folder.manifests import (
    read_manifest,
    write_contents,
    write_manifest,
    write_run_json,
)
from alpasim_plugin.log.run_folder.schema import MANIFEST, STEPS_NAME


def vouch_for(root: Path) -> Path:
    """Write ``run.json``, the manifests and ``contents.json`` of a run folder again, as they stand,
    and return the folder.
    """
    info = json.loads((root / "run.json").read_text())
    info.pop(SEAL, None)
    write_run_json(root, {"key": "by hand"} | info)
    rows = pq.read_table(
        root / "rollouts.parquet", columns=["renderer", "policy", "scene", "seed", "status", "path"]
    ).to_pylist()
    for row in rows:
        folder = root / row["path"]
        held = json.loads((folder / MANIFEST).read_text()) if (folder / MANIFEST).exists() else {}
        held.pop(SEAL, None)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / STEPS_NAME).touch()
        write_manifest(folder, row | held)
    write_contents(root, {row["path"]: read_manifest(root / row["path"])[1] for row in rows})
    return root
