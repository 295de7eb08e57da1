"""Paths of probes in a run folder, and the search for a stored probe."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from alpasim_plugin.runtime.plan import slug
from alpasim_plugin.runtime.store import read_json
from evaluators.report.run_folder import Rollout

PROBES = "probes"
PROBE_JSON, PROBE_TABLE, PROBE_PLOT = "probe.json", "probe.parquet", "probe.png"


def probe_folder(renderer: str, policy: str, scene: str, seed: int, renderers: tuple[str, ...]) -> Path:
    """Return the folder of a probe of ``renderers`` along a rollout, relative to the run folder."""
    return Path(PROBES, slug(renderer), slug(policy), slug(scene), str(seed), slug("--".join(renderers)))


def find_probe(root: Path, driven: Rollout, other: str) -> Mapping[str, Any] | None:
    """Return the first divergence that a probe along a rollout found between its renderer and another; None without such a probe."""
    folder = root / PROBES / slug(driven.renderer) / slug(driven.policy) / slug(driven.scene) / str(driven.seed)
    for path in sorted(folder.glob(f"*/{PROBE_JSON}")):
        for pair in read_json(path)["pairs"]:
            if pair["reference"] == driven.renderer and pair["renderer"] == other:
                first = pair["first_divergence"]
                if first is None:
                    return {"t_us": None, "reason": "a probe at identical poses found no divergence"}
                frames = {r: (path.parent / name).relative_to(root).as_posix() for r, name in first["frames"].items()}
                return dict(first) | {"frames": frames}
    return None
