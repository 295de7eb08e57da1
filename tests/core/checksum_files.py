"""Make a folder that a test wrote or changed by hand into one that a run wrote."""

import json

import pyarrow.parquet as pq

from alpasim_plugin.log.run_folder.checksums import state_files
from alpasim_plugin.log.run_folder.manifests import write_manifest, write_run_json
from alpasim_plugin.log.run_folder.schema import MANIFEST, RUN_INFO, STEPS_NAME, TABLES
from tests.run_records import manifest, run_info

KEYS = ["renderer", "policy", "scene", "seed", "status", "path"]


def vouch_for(root):
    """Write ``run.json``, the manifests and ``files.json`` of a run folder again, as they stand,
    with the digests of their files, and return the folder.
    """
    rows = pq.read_table(root / "rollouts.parquet", columns=KEYS).to_pylist()
    info = {"key": "by hand"} | json.loads((root / "run.json").read_text())
    write_run_json(root, run_info(info | {"rollouts": [row["path"] for row in rows]}))
    for row in rows:
        folder = root / row["path"]
        held = json.loads((folder / MANIFEST).read_text()) if (folder / MANIFEST).exists() else {}
        folder.mkdir(parents=True, exist_ok=True)
        (folder / STEPS_NAME).touch()
        write_manifest(folder, manifest(row | held))
    state_files(root, [RUN_INFO, *TABLES])
    return root
