"""A scene with the range of its plans: the file that ``simrun bench real --range -o`` writes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_text
from alpasim_plugin.core.files.places import temporary_folder
from alpasim_plugin.core.files.reading import real
from alpasim_plugin.core.parts.resolve import RendererSpec
from alpasim_plugin.core.parts.spec import PartSpec, short_digest
from alpasim_plugin.core.types import Scenario
from scenarios.load import load_scenario
from scenarios.sources import open_document
from scenarios.suite import find


def check_target(out: Path, drives: Sequence[Path], find_range: bool) -> None:
    """Refuse to write a range where none is looked for, of several scenes, or over a file.

    Raises:
        InputError: It is so.
    """
    if not find_range or len(drives) != 1:
        raise InputError(
            f"-o {out}: it takes --range and one scene", "give --range, and one scene a command"
        )
    if out.suffix not in (".yaml", ".yml"):
        raise InputError(f"-o {out}: no YAML file", f"write for example {out.with_suffix('.yaml')}")
    if os.path.lexists(out):
        raise InputError(f"-o {out}: it exists", "name another file, or remove it")


def write_ranges(
    out: Path,
    scene: Path,
    scenario: Scenario,
    ranges: Sequence[Mapping[str, Any]],
    gaps: Sequence[Mapping[str, Any]],
    renderers: Mapping[str, RendererSpec],
    policies: Sequence[PartSpec],
) -> None:
    """Write a scenario file that is the scene with `plan_ranges`.

    Args:
        out: The file.
        scene: As it was named on the command line.
        scenario: The scene.
        ranges: Of `gap_ranges`.
        gaps: Of `gap_rows`, from which they were made.
        renderers: With which the ranges were looked for.
        policies: With which the ranges were looked for.

    Raises:
        InputError: The plans of a policy are too short to be compared.
    """
    for row in gaps:
        if row["lateral_2s_m"] is None:
            raise InputError(
                f"--policy {row['policy']}: its plans end before two seconds, so that they have no range",
                "leave this policy out",
            )
    path = find(str(scene))
    if path.suffix in (".yaml", ".yml"):
        content: dict[str, Any] = {"version": 1, "extends": [str(real(path))]}
    else:
        content = dict(open_document(path, None).data)
    content["scene_id"] = scenario.scene_id
    # The same scene under the same name; its digest is that of this file without ranges.
    with temporary_folder("simrun-") as folder:
        plain = Path(folder) / out.name
        write_text(plain, yaml.safe_dump(content))
        digest = short_digest(load_scenario(str(plain)).content_hash)
    parts: list[RendererSpec | PartSpec] = [*renderers.values(), *policies]
    digests = {part.name: _digest_of(part) for part in parts}
    content["plan_ranges"] = [
        {
            "renderer": row["renderer"],
            "policy": row["policy"],
            "near_to_m": row["near_to_m"],
            "scene": digest,
            "renderer_digest": digests[row["renderer"]],
            "policy_digest": digests[row["policy"]],
        }
        for row in ranges
    ]
    write_text(out, yaml.safe_dump(content, sort_keys=False))


def _digest_of(spec: RendererSpec | PartSpec) -> str | None:
    """Return the digest of a part; None where what it does is decided elsewhere."""
    return None if spec.digest is None else short_digest(spec.digest)
