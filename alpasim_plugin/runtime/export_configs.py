"""The configuration files of an AlpaSim run folder, as its evaluation, aggregation and re-evaluation read them."""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

import yaml

from alpasim_plugin.io.atomic import write_text
from evaluators.alpasim import EvalSettings
from scenarios.cosmos_camera import FRONT_WIDE

RUN_METADATA, EVAL_CONFIG, WIZARD_CONFIG = "run_metadata.yaml", "eval-config.yaml", "wizard-config.yaml"
SCENES = "scenes"


def write_configs(folder: Path, final: Path, name: str, identity: str) -> None:
    """Write the three files of one run folder.

    Args:
        folder: Where to write now.
        final: The export's own folder when it is done; ``alpasim-reeval`` looks for the scenes below it, by its absolute path.
        name: The run's name in AlpaSim's tables.
        identity: What determines the run; equal runs have equal ids.
    """
    metadata = {"run_uuid": str(uuid.uuid5(uuid.NAMESPACE_URL, identity)), "run_name": name}
    wizard = {
        "services": {"runtime": {"image": "none"}},  # alpasim-reeval needs the key; only its Slurm mode uses the image
        "scenes": {"scene_cache": str(final.absolute()), "sceneset_path": SCENES},
        "wizard": {"sqshcaches": []},
    }
    for file, content in ((RUN_METADATA, metadata), (EVAL_CONFIG, eval_config()), (WIZARD_CONFIG, wizard)):
        write_text(folder / file, yaml.safe_dump(content, sort_keys=False))


def eval_config() -> dict[str, Any]:
    """Return AlpaSim's evaluation settings: its defaults, no video, and no unpickling of what a driver sent."""
    own = EvalSettings().model_dump(mode="json", exclude={"run_in_runtime", "vec_map", "video"})
    return own | {
        "vec_map": {
            "incl_road_edges": True,
            "incl_traffic_signs": True,
            "incl_wait_lines": True,
            "max_num_lanes": 20,
            "num_pts_per_lane": 20,
        },
        "video": {
            "render_video": False,
            "video_layouts": ["DEFAULT"],
            "camera_id_to_render": FRONT_WIDE,
            "render_every_nth_frame": 1,
            "generate_combined_video": False,
            "combined_video_speed_factor": 0.33,
            "map_video": {"map_radius_m": 20, "ego_loc": "BOTTOM_CENTER", "rotate_map_to_ego": True},
        },
    }
