"""Say how a scenario's reconstruction is fitted, name it by its content (scene, recipe, version of
the code), and keep its files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from alpasim_plugin.core.detail import halvings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import content_of
from alpasim_plugin.core.files.arrays import read_npz
from alpasim_plugin.core.files.inputs import Inputs
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.scene.log_views import SkyView

if TYPE_CHECKING:
    from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction

# By second of the log and camera, so that neither a longer drive nor a rig of more cameras is fitted
# worse; a lens counts as the pinholes that cover it.
POINTS_PER_S = 2_400
FULL_STEPS_PER_S = 50.0
LONGEST_S = 30.0  # a longer log gets the points and steps of so many seconds
REFUSED_S = 120.0  # of a longer log next to nothing would be left
FEWEST_VIEWS = 12
MOST_VIEWS = 180  # by camera
ACTOR_POINTS = 400  # by camera
# A camera that looks ahead sees a surface for seconds, one that looks to the side for less than
# one: with several, start points come from every second instant, and each view is learned from twice
# as often.
INSTANTS_ONE_CAMERA = 6
INSTANTS_RIG = 2
STEPS_RIG = 2.0
# Steps, points and pixels across of views, where a camera has so many pixels per radian that the
# street is built finer (`halvings`); one such camera is fitted as one of several. An error of depth
# moves what a fixer takes from recorded frames by as many more pixels.
SHARP = 2


STEP_CPU_S = 0.06  # of a fit, by step
POINT_CPU_S = 7e-7  # of a fit, by step and point


@dataclass(frozen=True)
class ReconstructionRecipe:
    """How a reconstruction is made.

    Attributes:
        splat: How Gaussians are fitted.
        lateral_offset_m: Where the views lie that they are fitted to: to the left of the logged path.
        fit_actors: Fit actors as rigid nodes; otherwise all are spliced in from the scene as built.
        depth_every: At every such instant all cameras' views give points to start from.
        range_error: Spread of these points' distance from their view, as a share of it.
        size: Of the Gaussians at the start, in distances to their neighbours: below one, the ground
            shows through until they have grown.
        opacity: Of the Gaussians at the start.
        pose_error_m: Spread of the views' believed places, metres; their directions err in
            proportion.
        place: Where it is fitted, ``cpu`` or ``cuda``: their last digits differ.
    """

    splat: SplatRecipe
    lateral_offset_m: float
    fit_actors: bool
    depth_every: int = INSTANTS_ONE_CAMERA
    range_error: float = 0.1
    size: float = 0.6
    opacity: float = 0.2
    pose_error_m: float = 0.0
    place: str = "cpu"


def recipe_of(scenario: Scenario, device: str = "cpu") -> ReconstructionRecipe:
    """Return the recipe of a scenario's degradation, which is fitted to what its cameras saw along
    the log.

    Few points, small views, no densification: a model that some seconds of one core and camera can
    fit. Rates are higher than those of a whole fit, as a schedule of hundreds of steps needs.

    Raises:
        InputError: The degradation is not one that fits a model.
    """
    amount = scenario.degradation
    if amount.kind not in ("reconstruction", "cycle"):
        raise InputError(
            f"degradation kind {amount.kind!r}: nothing to fit",
            "say reconstruction or cycle",
        )
    cameras = max(1, len(scenario.cameras))
    is_sharp = bool(halvings(scenario))
    detail = SHARP if is_sharp else 1
    is_rig = cameras > 1 or is_sharp
    log_s = (scenario.ego_log.t_us[-1] - scenario.ego_log.t_us[0]) * 1e-6
    watched_s = cameras * min(LONGEST_S, log_s)
    steps = detail * amount.share * FULL_STEPS_PER_S * watched_s * (STEPS_RIG if is_rig else 1.0)
    views = min(MOST_VIEWS * cameras, round(amount.views_per_s * log_s * cameras))
    points = detail * max(POINTS_PER_S, round(POINTS_PER_S * watched_s))
    splat = SplatRecipe(
        steps=max(1, round(steps)),
        views=max(FEWEST_VIEWS, views),
        width=160 * detail,
        points=points,
        actor_points=detail * ACTOR_POINTS * cameras,
        cap=points,
        sh_degree=1,
        lr_means=4e-4,
        lr_means_end=4e-5,
        lr_scales=1e-2,
        lr_quaternions=2e-3,
        lr_opacities=0.05,
        lr_colour=5e-3,
        densify_every=0,
    )
    on_path = amount.kind == "reconstruction"
    lateral_offset_m = 0.0 if on_path else amount.shift_m
    return ReconstructionRecipe(
        splat,
        lateral_offset_m,
        on_path,
        depth_every=INSTANTS_RIG if is_rig else INSTANTS_ONE_CAMERA,
        range_error=amount.depth_error,
        pose_error_m=amount.pose_error_m,
        place=device.partition(":")[0],
    )


def fit_cpu_s(scenario: Scenario, pinholes: int) -> float:
    """Estimate the CPU time of a scenario's fit within a factor of two; 0 where nothing is fitted.

    Args:
        scenario: Its cameras may have lenses.
        pinholes: How many draw them.
    """
    log_s = float(np.ptp(scenario.ego_log.t_us)) * 1e-6
    if scenario.model is not None or scenario.degradation.kind == "none" or log_s > REFUSED_S:
        return 0.0
    cameras = tuple(islice(cycle(scenario.cameras), pinholes))
    splat = recipe_of(replace(scenario, cameras=cameras)).splat
    return splat.steps * (STEP_CPU_S + POINT_CPU_S * splat.points)


# what it imports decides, with the scene and the recipe, what the model is

# What neither the frames of the logged drive nor the fit depend on. The source's hash is left out
# because everything it stands for is here, the paths of files because their content is.
_FILES = frozenset({"path", "appearance"})  # fields that name a file
_NO_MATTER = frozenset(
    {
        "source",
        "rates",
        "start_us",
        "end_us",
        "warmup_us",
        "latency",
        "degradation",
        "world_origin",
        "content_hash",
        "notes",
        "alpasim_map",
        "behaviour",
        "model",
        "files",
        "source_part",
        "stop_at_path_end",
        "route_offset_m",
        "varied",
    }
)


def reconstruction_key(scenario: Scenario, recipe: object) -> str:
    """Return 32 hexadecimal digits that two reconstructions share only if they are the same.

    Args:
        scenario: The scene; how long it is driven, its rates and how actors behave in a loop do not
            matter, its log and tracks do.
        recipe: Numbers, texts, arrays, and mappings, sequences and dataclasses of them.

    Raises:
        TypeError: A value of another type.
        InputError: A file that the scenario shows cannot be read.
    """
    clear = replace(scenario, environment=scenario.environment.in_clear_day)
    with Inputs() as inputs:
        inputs.setting("code", package_digest())
        inputs.setting("recipe", _content(recipe))
        inputs.setting("scene", _content(clear))
        for path in scenario.shown_files:
            content_of(path)
    return inputs.key[:32]


def model_key(scenario: Scenario, device: str) -> str | None:
    """Return the key of what the renderer ``3dgs`` shows of a scenario on a device; None where nothing is
    fitted.
    """
    if scenario.degradation.kind == "none":
        return None
    return reconstruction_key(scenario, recipe_of(scenario, device))


def _content(value: object) -> object:
    """Return what JSON can write of a value, without the fields that do not matter; arrays by their
    digest.
    """
    if isinstance(value, np.ndarray):
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return [value.dtype.str, value.shape, digest]
    if is_dataclass(value):
        named = {field.name: getattr(value, field.name) for field in fields(value)}
        kept = {
            name: content_of(part) if name in _FILES and part is not None else _content(part)
            for name, part in named.items()
            if name not in _NO_MATTER
        }
        return [type(value).__name__, kept]
    if isinstance(value, Mapping):
        return {name: _content(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_content(part) for part in value]
    return value.item() if isinstance(value, np.number) else value


SKY_VIEWS = "sky_views.npz"
DO_THIS = "remove its folder; it is made again when it is needed"


def write_model(
    folder: Path, model: Reconstruction, sky_views: Sequence[SkyView], facts: Mapping[str, Any]
) -> None:
    """Write a reconstruction and its sky views into an existing, empty folder.

    Raises:
        InfrastructureError, OSError: The disk refuses.
    """
    model.save(folder, facts)
    bits = [np.packbits(view.sky > 0.5) for view in sky_views]
    np.savez_compressed(
        folder / SKY_VIEWS,
        size=np.array(
            [[view.camera.width, view.camera.height] for view in sky_views], dtype=np.int64
        ).reshape(-1, 2),
        K=np.array([view.camera.K for view in sky_views]).reshape(-1, 3, 3),
        T_camera_world=np.array([view.camera.T_camera_world for view in sky_views]).reshape(
            -1, 4, 4
        ),
        sky=np.concatenate(bits) if bits else np.zeros(0, dtype=np.uint8),
        name=np.array([view.name for view in sky_views], dtype=np.str_),
    )


def read_model(folder: Path) -> tuple[Reconstruction, list[SkyView]]:
    """Read what `write_model` wrote.

    Raises:
        InputError: A file is missing or damaged.
    """
    # Imported on use: it loads the rasteriser, which a key does not need.
    from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction

    return Reconstruction.load(folder), _read_sky_views(folder / SKY_VIEWS)


def _read_sky_views(path: Path) -> list[SkyView]:
    fields = ("size", "K", "T_camera_world", "sky", "name")
    sizes, Ks, Ts, bits, names = read_npz(path, fields, DO_THIS)
    views = []
    first = 0
    for (width, height), K, T, name in zip(sizes.tolist(), Ks, Ts, names.tolist(), strict=True):
        length = -(-width * height // 8)
        sky = np.unpackbits(bits[first : first + length], count=width * height).reshape(
            height, width
        )
        views.append(SkyView(PinholeCamera(width, height, K, T), sky.astype(np.float32), name))
        first += length
    return views
