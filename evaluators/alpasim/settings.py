"""AlpaSim's evaluation settings (``eval-config.yaml``) and the preset that they stand for."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.core.files.config import load_yaml, validate
from alpasim_plugin.core.json_types import JsonObject
from evaluators.metrics.presets import ALPASIM, Preset


class _Part(BaseModel):
    """A section: frozen, and no key that AlpaSim does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class MinAde(_Part):
    """Scorer of plan samples."""

    time_deltas: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(0.5, 1.0, 2.5, 5.0), min_length=1
    )
    incl_z: bool = False
    target: Literal["GT", "SELF"] = "GT"


class PlanDeviation(_Part):
    """Scorer of consecutive plans."""

    incl_z: bool = False
    avg_decay_rate: float = 0.1
    min_timesteps: int = 5  # AlpaSim reads it and never uses it


class Image(_Part):
    """Scorer of black images."""

    camera_logical_id: str = "camera_front_wide_120fov"


class OpenLoopCollision(_Part):
    """Scorer of planned contacts."""

    horizon_s: float = Field(default=3.0, gt=0)


class Scorers(_Part):
    """Settings of single scorers."""

    min_ade: MinAde = MinAde()
    plan_deviation: PlanDeviation = PlanDeviation()
    image: Image = Image()
    open_loop_collision: OpenLoopCollision = OpenLoopCollision()


class VehicleShape(_Part):
    """Footprint of the ego and all actors."""

    vehicle_shrink_factor: float = Field(default=0.02, ge=0, lt=1)
    vehicle_corner_roundness: float = Field(default=0.5, ge=0, lt=1)


class SceneScoreSettings(_Part):
    """The score of a rollout."""

    enabled: bool = True
    min_gt_distance_for_full_score_m: float = 5.0
    progress_saturation_threshold: float = Field(default=0.8, gt=0)


class Modifiers(_Part):
    """What ends a rollout early."""

    max_dist_to_gt_trajectory: float = 4.0


class EvalSettings(_Part):
    """The settings file. Sections that change no number (video, vec_map, processes) are accepted
    and not used.
    """

    aggregation_modifiers: Modifiers = Modifiers()
    allow_aggregation_with_failed_rollouts: bool = False
    scene_score: SceneScoreSettings = SceneScoreSettings()
    scorers: Scorers = Scorers()
    vehicle: VehicleShape = VehicleShape()
    enabled: bool = True
    num_processes: int = 1
    parse_unstructured_debug_info: bool = (
        False  # accepted; a driver's pickled bytes are never opened here
    )
    run_in_runtime: bool = True
    vec_map: JsonObject = {}
    video: JsonObject = {}

    def preset(self, version: Preset = ALPASIM) -> Preset:
        """Return the preset of a version of AlpaSim with these settings."""
        scorers = self.scorers
        return replace(
            version,
            shrink=self.vehicle.vehicle_shrink_factor,
            roundness=self.vehicle.vehicle_corner_roundness,
            stop_beyond_gt_m=self.aggregation_modifiers.max_dist_to_gt_trajectory,
            open_loop_horizon_us=round(scorers.open_loop_collision.horizon_s * 1e6),
            plan_decay=scorers.plan_deviation.avg_decay_rate,
            plan_with_z=scorers.plan_deviation.incl_z,
            min_ade_horizons_s=scorers.min_ade.time_deltas,
            min_ade_with_z=scorers.min_ade.incl_z,
            min_ade_target="gt" if scorers.min_ade.target == "GT" else "self",
            image_camera=scorers.image.camera_logical_id,
        )


def load_settings(path: str | Path) -> EvalSettings:
    """Read a settings file.

    Raises:
        InputError: Missing or broken file, unknown key, or a value out of range, with line and
            column.
    """
    return validate(EvalSettings, load_yaml(path))
