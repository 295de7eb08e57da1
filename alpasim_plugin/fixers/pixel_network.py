"""The generator in pixels from its weights, or untrained; loaded once per process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.fixers.bundle import read_bundle, weights_to_give
from alpasim_plugin.fixers.gather import CPU
from alpasim_plugin.fixers.network.pixel_generator import (
    TORCH,
    PixelGenerator,
    PixelSizes,
    PixelState,
)
from alpasim_plugin.fixers.network.reference_blend import CELL, DETAIL, BlendHeads, Operations
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}


@dataclass(frozen=True, eq=False)
class LoadedGenerator:
    """A generator ready to run; read-only and stateless, so rollouts share it."""

    net: PixelGenerator
    operations: Operations
    trained: bool
    note: str  # description of the weights, for labels
    device: torch.device


def load_generator(settings: PixelFixerSettings, device: str = "cpu") -> LoadedGenerator:
    """Build the generator that the settings name, or return it if this process has built it before.

    Raises:
        InputError: Weights that are missing or do not fit.
        InfrastructureError: The device is not here.
    """
    name = require_device(device)
    return _load(settings.model_copy(update={"keep_render": True}), name)


@lru_cache(maxsize=4)
def _load(settings: PixelFixerSettings, device: str) -> LoadedGenerator:
    if settings.weights.bundle is not None:
        bundle = read_bundle(settings.weights.bundle, settings)
        net = PixelGenerator.from_state_dict(bundle.parts["generator"], settings.weights.bundle)
        trained = bundle.trained
        note = bundle.note
    else:
        net = _untrained(settings)
        trained = False
        note = f"untrained ({settings.untrained})"
    net = net.requires_grad_(False).eval().to(device=device, dtype=DTYPES[settings.precision])
    operations = CPU if device == "cpu" else TORCH
    return LoadedGenerator(net, operations, trained, note, torch.device(device))


def _untrained(settings: PixelFixerSettings) -> PixelGenerator:
    if settings.untrained == "refuse":
        raise InputError(
            f"{settings.name}, weights.bundle: no weights, and settings.untrained is 'refuse'",
            weights_to_give("bundle"),
        )
    sizes = PixelSizes(**settings.generator.model_dump())
    net = PixelGenerator.random(sizes, derive_seed("fixer", 0, settings.name))
    if settings.untrained == "identity":
        torch.nn.init.zeros_(net.write.weight)
    return net


def draw_and_warp() -> None:
    """Draw a line and a car, and carry an image into another view: tiny cases of the kernels of
    what a fixer is given.
    """
    from alpasim_plugin.core.geometry import se2
    from alpasim_plugin.core.types import Box, CameraSpec, LaneMap
    from alpasim_plugin.fixers.ground import carry
    from alpasim_plugin.fixers.semantic_map.draw import draw_map
    from alpasim_plugin.fixers.semantic_map.prepare import ActorBox, prepare_map
    from alpasim_plugin.fixers.trust import trust
    from alpasim_plugin.fixers.warp import Picture, WarpTarget, on_boxes, place_boxes

    side_px = 16
    ahead = np.array(
        [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]
    )  # camera axes in a rig that looks along x
    edge = np.array([[2.0, -1.0, 0.0], [9.0, 1.0, 0.0]])
    K = np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]])
    T_world_car, box = se2(5.0, 0.0, 0.0, 0.8), Box(4.5, 1.9, 1.6)
    camera = CameraSpec("front", side_px, side_px, K, ahead)
    draw_map(
        prepare_map(LaneMap({}, road_edges=(edge,))),
        camera,
        ahead,
        [ActorBox(T_world_car, box, "car")],
        threads=1,
    )

    depth = np.ones((side_px, side_px), np.float32)
    picture = Picture(
        K, ahead, np.zeros((side_px, side_px, 3), np.uint8), depth, {"car": T_world_car}
    )
    carry([picture], WarpTarget(K, ahead, depth, {"car": T_world_car}, {"car": box}), np.eye(4))
    for focal_px in (8.0, 80.0):  # the car fills a part of the image's rows, and all of them
        zoomed = np.array([[focal_px, 0, 8], [0, focal_px, 8], [0, 0, 1]])
        on_boxes(
            depth.shape,
            place_boxes(depth.shape, zoomed, ahead, {"car": T_world_car}, {"car": box}).seen,
        )
    image = np.zeros((side_px, side_px, 3), np.float32)
    trust(image, image, depth)


def gather_and_mix() -> None:
    """Run a tiny case of every operation of the network."""
    side_px = 16
    image = torch.zeros(1, side_px, side_px, 3)
    references = torch.zeros(1, 1, side_px, side_px, 4, dtype=torch.uint8)
    state = PixelState(image, image, image[:, ::CELL, ::CELL], image[..., :1])
    CPU.gather_cells(image, image[..., :1], image, state, image + 1)
    CPU.gather_references(references, image, 1)
    at2, at4 = image[:, ::DETAIL, ::DETAIL], image[:, ::CELL, ::CELL]
    heads = at2[:, None, ..., :1].repeat(1, 1, 1, 1, 18)
    weight, offset, correction = heads.split([4, 2, 12], dim=-1)  # type: ignore[no-untyped-call]
    moved = CPU.offsets(offset[:, 0], at4[..., :2])[:, None]
    CPU.likeness(at4, at4)
    CPU.blend(image, references, BlendHeads(weight, moved, correction), 1)
