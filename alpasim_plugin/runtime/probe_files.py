"""Where probes lie in a run folder, and how their answers are found."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from alpasim_plugin.runtime.plan import slug
from alpasim_plugin.runtime.store import read_json
from evaluators.report.run_folder import Rollout

PROBES = "probes"
PROBE_JSON, PROBE_TABLE, PROBE_PLOT = "probe.json", "probe.parquet", "probe.png"


def probe_folder(renderer: str, policy: str, scene: str, seed: int, asked: tuple[str, ...]) -> Path:
    """Return the folder of a probe below the run folder: along which rollout, and which renderers were asked."""
    return Path(PROBES, slug(renderer), slug(policy), slug(scene), str(seed), slug("--".join(asked)))


def find_probe(root: Path, driven: Rollout, other: str) -> Mapping[str, Any] | None:
    """Return what a probe along a rollout found between its own renderer and another one; None where there is no such probe."""
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
