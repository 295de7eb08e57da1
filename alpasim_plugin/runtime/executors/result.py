"""A finished rollout on its way from a node to the run folder: its manifest and its files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.io.atomic import disk_error
from alpasim_plugin.run_folder.manifests import read_manifest, write_manifest
from alpasim_plugin.run_folder.schema import DERIVED, DRIVEN, MANIFEST, OUTPUT_NAME

NAMES = (*DRIVEN, *DERIVED)


@dataclass(frozen=True)
class RolloutResult:
    """A rollout.

    Attributes:
        manifest: As the node wrote it; ``files`` has the digests of ``files``.
        files: Content by name.
    """

    manifest: dict[str, Any]
    files: Mapping[str, bytes]


def pack(folder: Path, node: str) -> RolloutResult:
    """Read a rollout's folder, whose manifest was just written.

    Raises:
        InputError: The manifest is damaged.
        OSError: A file cannot be read.
    """
    manifest, _ = read_manifest(folder)
    names = list(manifest["files"]) or [OUTPUT_NAME]  # of a failed rollout only what its parts printed
    files = {name: (folder / name).read_bytes() for name in names if (folder / name).exists()}
    return RolloutResult({"node": node, **manifest}, files)


def unpack(result: RolloutResult, root: Path) -> dict[str, Any]:
    """Write a rollout below a run folder, its manifest last, and return the manifest.

    Raises:
        InfrastructureError: A file is not what the node wrote, or the disk refuses.
    """
    folder = root / result.manifest["path"]
    for name, facts in result.manifest["files"].items():
        if hashlib.sha256(result.files[name]).hexdigest() != facts["sha256"]:
            where = f"{result.manifest['path']}/{name} from {result.manifest['node']}"
            raise InfrastructureError("receiving a rollout", where, "not the content that the node wrote", "give the same command again")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (MANIFEST, *NAMES):  # the manifest first: without it nothing is trusted
            (folder / name).unlink(missing_ok=True)
        for name, data in result.files.items():
            (folder / name).write_bytes(data)
    except OSError as error:
        raise disk_error(folder, error, "writing a rollout") from error
    manifest = {name: value for name, value in result.manifest.items() if name != "files"}
    write_manifest(folder, manifest)
    return manifest
