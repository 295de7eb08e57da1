"""The generator in pixels, from weights or untrained, loaded once per process and recorded once a
shape repeats.

The network has some forty small operations, and Python between them takes a tenth of a frame's time
on a CPU. A recording (TorchScript, frozen weights) runs the same operations without it.

A picture larger than those of the training is looked at ``scale`` times smaller: the network's
change of the render, the weights, offsets and corrections of the references are enlarged, and
render and references are blended at their own size (joint upsampling; Kopf et al., 2007), so what
is sharp in them stays sharp.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core import kernels
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.fixers.bundle import read_bundle, weights_to_give
from alpasim_plugin.fixers.gather import (
    gather_beside_cpu,
    gather_cells_cpu,
    likeness_cpu,
    mix_cpu,
    offsets_cpu,
)
from alpasim_plugin.fixers.network.machine_probe import Choice, choose_precision, require_device
from alpasim_plugin.fixers.network.pixel_generator import (
    BeforeBlend,
    GatheredCells,
    PixelGenerator,
    PixelSizes,
    PixelState,
    gather_cells,
)
from alpasim_plugin.fixers.network.pixel_layers import pack
from alpasim_plugin.fixers.network.reference_blend import (
    CELL,
    DETAIL,
    BesideCells,
    BlendHeads,
    enlarged,
    gather_beside,
    mix,
    sources_of,
)
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.fixers.views import HALF

DOING = "loading the network of a fixer"
DTYPES: Mapping[Literal["fp32", "bf16"], torch.dtype] = {
    "fp32": torch.float32,
    "bf16": torch.bfloat16,
}
AFTER = 8  # frames of a shape before it is recorded: recording takes as long as some thirty frames


@dataclass(frozen=True, eq=False)
class LoadedGenerator:
    """A generator ready to run; read-only and stateless, so rollouts share it."""

    net: PixelGenerator
    step: GeneratorStep  # the same for pictures of any size
    trained: bool
    note: str  # description of the weights, for labels
    precision: Choice
    device: torch.device


def load_generator(settings: PixelFixerSettings, device: str = "cpu") -> LoadedGenerator:
    """Build the generator that the settings name, or return it if this process has built it before.

    Raises:
        InputError: Weights that are missing or do not fit.
        FixerError: The device does not work.
    """
    require_device(device)
    return _load(settings.model_copy(update={"keep_render": True}), device)


@lru_cache(maxsize=4)
def _load(settings: PixelFixerSettings, device: str) -> LoadedGenerator:
    precision = choose_precision(settings.precision, device)
    if settings.weights.bundle is not None:
        bundle = read_bundle(settings.weights.bundle, settings)
        net = PixelGenerator.from_state_dict(bundle.parts["generator"], settings.weights.bundle)
        trained = bundle.trained
        note = bundle.note
    else:
        net = _untrained(settings)
        trained = False
        note = f"untrained ({settings.untrained})"
    net = net.requires_grad_(False).eval().to(device=device, dtype=DTYPES[precision.name])
    if device == "cpu" and torch.backends.mkldnn.is_available():  # type: ignore[no-untyped-call]
        pack(net)
    if device == "cpu" and net.blend is not None:
        net.blend.likeness, net.blend.offsets = likeness_cpu, offsets_cpu
    step = RecordedStep(net) if device == "cpu" else GeneratorStep(net)
    return LoadedGenerator(net, step, trained, note, precision, torch.device(device))


def _untrained(settings: PixelFixerSettings) -> PixelGenerator:
    if settings.untrained == "refuse":
        raise InputError(
            f"{settings.name}, weights.bundle: no weights, and settings.untrained is 'refuse'",
            weights_to_give("bundle"),
        )
    given = settings.generator
    sizes = PixelSizes(**given.model_dump())
    net = PixelGenerator.random(sizes, derive_seed("fixer", 0, settings.name))
    if settings.untrained == "identity":
        torch.nn.init.zeros_(net.write.weight)
    return net


class GeneratorStep:
    """Call a generator for pictures of any size.

    Args:
        net: In evaluation mode, never written to.
    """

    def __init__(self, net: PixelGenerator) -> None:
        self.net = net

    def start(self, render: Tensor, scale: int = 1) -> PixelState:
        """Return the state before a rollout; see `PixelGenerator.start`. Pictures have their own
        size, recurrent channels the network's.
        """
        hidden = self.net.start(smaller(render, scale))
        return hidden._replace(
            output=render, render=render, recorded=torch.zeros_like(render[..., :1])
        )

    def __call__(
        self,
        render: Tensor,
        opacity: Tensor,
        sdmap: Tensor,
        state: PixelState,
        source: Tensor,
        references: Tensor | None = None,
        t: Tensor | None = None,
        scale: int = 1,
    ) -> tuple[Tensor, PixelState]:
        """Return the clean frame and the state after it; see `PixelGenerator.forward`, whose
        arguments these are.

        Args:
            render, opacity, sdmap, state, source, references, t: Sides are multiples of 16
                ``scale``; references are bytes.
            scale: The network looks at pictures that are this many times smaller.
        """
        seen = smaller(render, scale)
        past = state._replace(
            output=smaller(state.output, scale), render=smaller(state.render, scale)
        )
        beside = (
            None
            if references is None or self.net.blend is None
            else self.beside(references, seen, scale)
        )
        noised = seen if source is render else smaller(source, scale)
        cells = self.gather(seen, smaller(opacity, scale), smaller(sdmap, scale), past, noised)
        made = self.before_blend(cells, seen, past, t, beside)
        out, recorded = made.repaired, torch.zeros_like(render[..., :1])
        if scale > 1:
            out = render + larger(made.repaired - seen, scale)
        if made.heads is not None and references is not None:
            out, recorded = self.mix(out, references, made.heads, scale)
        return out, PixelState(
            out.clamp(-1, 1), render, made.hidden, made.kept, made.frames, recorded
        )

    def gather(
        self, render: Tensor, opacity: Tensor, sdmap: Tensor, past: PixelState, source: Tensor
    ) -> GatheredCells:
        """Gather what the network reads beside references; see `nets.pixel_generator.gather_cells`,
        whose arguments these are.
        """
        return gather_cells(render, opacity, sdmap, past, source)

    def beside(self, references: Tensor, render: Tensor, scale: int) -> BesideCells:
        """Gather what the network reads of references that are ``scale`` times larger than the
        render.
        """
        seen = smaller(in_floats(references).flatten(0, 1), scale)
        return gather_beside(seen.view(*references.shape[:2], *seen.shape[1:]), render)

    def before_blend(
        self,
        cells: GatheredCells,
        render: Tensor,
        past: PixelState,
        t: Tensor | None,
        beside: BesideCells | None,
    ) -> BeforeBlend:
        """Run the network on what it looks at."""
        return self.net.before_blend(cells, render, past, t, beside)

    def mix(
        self, repaired: Tensor, references: Tensor, heads: BlendHeads, scale: int
    ) -> tuple[Tensor, Tensor]:
        """Blend at full size; see `nets.reference_blend`."""
        return mix(sources_of(repaired, in_floats(references), heads, scale))


class RecordedStep(GeneratorStep):
    """Call a generator on the CPU; equal to calling the network, to rounding.

    Args:
        net: In evaluation mode, never written to.
        after: Calls of a shape at t = 1 before it is recorded; None records nothing.
    """

    def __init__(self, net: PixelGenerator, after: int | None = AFTER) -> None:
        super().__init__(net)
        self._step, self._after = _Step(net).eval(), after
        self._calls: Counter[tuple[int, ...]] = Counter()
        self.recorded: dict[tuple[int, ...], Any] = {}

    def gather(
        self, render: Tensor, opacity: Tensor, sdmap: Tensor, past: PixelState, source: Tensor
    ) -> GatheredCells:
        """Gather in one compiled pass."""
        return gather_cells_cpu(render, opacity, sdmap, past, source, self.net.stem.weight.dtype)

    def beside(self, references: Tensor, render: Tensor, scale: int) -> BesideCells:
        """Gather in one compiled pass."""
        return gather_beside_cpu(references, render, scale, self.net.stem.weight.dtype)

    def before_blend(
        self,
        cells: GatheredCells,
        render: Tensor,
        past: PixelState,
        t: Tensor | None,
        beside: BesideCells | None,
    ) -> BeforeBlend:
        """Run the network, or its recording, on what it looks at."""
        if t is not None:
            return super().before_blend(cells, render, past, t, beside)
        read = beside or ()
        tensors = *cells, render, *past, *read
        shape = *render.shape, *(part.shape[0] for part in read)
        self._calls[shape] += 1
        if (
            self._after is not None
            and shape not in self.recorded
            and self._calls[shape] > self._after
        ):
            self.recorded[shape] = _record(self._step, tensors)
        out, hidden, kept, frames, *heads = self.recorded.get(shape, self._step)(*tensors)
        return BeforeBlend(out, hidden, kept, frames, BlendHeads(*heads) if heads else None)

    def mix(
        self, repaired: Tensor, references: Tensor, heads: BlendHeads, scale: int
    ) -> tuple[Tensor, Tensor]:
        """Blend at full size in one compiled pass."""
        return mix_cpu(repaired, references, heads, scale)


def in_floats(references: Tensor) -> Tensor:
    """Return references of bytes ``(..., 4)`` as the network takes them: colour in [-1, 1], and
    where it holds, 0 to 1.
    """
    return torch.cat([references[..., :3] / HALF - 1, references[..., 3:] / (2 * HALF)], dim=-1)


def smaller(x: Tensor, scale: int) -> Tensor:
    """Average pictures ``(B, H, W, C)`` of at most four channels over squares of ``scale``
    pixels.
    """
    if scale == 1:
        return x
    if x.device.type != "cpu":
        return F.avg_pool2d(x.permute(0, 3, 1, 2), scale).permute(0, 2, 3, 1)
    return _resized(x, 1 / scale, cv2.INTER_AREA)


def larger(x: Tensor, scale: int) -> Tensor:
    """Enlarge pictures ``(B, H, W, C)`` bilinearly."""
    return enlarged(x, scale) if x.device.type != "cpu" else _resized(x, scale, cv2.INTER_LINEAR)


def _resized(x: Tensor, by: float, how: int) -> Tensor:
    """Resize by OpenCV, which is several times as fast as torch where channels come last."""
    out = torch.empty(x.shape[0], round(x.shape[1] * by), round(x.shape[2] * by), x.shape[3])
    for one, into in zip(x.contiguous().numpy(), out.numpy(), strict=True):
        cv2.resize(one, into.shape[1::-1], dst=into, interpolation=how)
    return out


class _Step(nn.Module):
    """The generator with tensors alone for arguments and results."""

    def __init__(self, net: PixelGenerator) -> None:
        super().__init__()
        self.net = net

    def forward(
        self, coarse: Tensor, fine: Tensor, render: Tensor, *others: Tensor
    ) -> tuple[Tensor, ...]:
        kept = len(PixelState._fields)
        beside = BesideCells(*others[kept:]) if len(others) > kept else None
        made = self.net.before_blend(
            GatheredCells(coarse, fine), render, PixelState(*others[:kept]), None, beside
        )
        return (*made[:-1], *(made.heads or ()))


def _record(step: _Step, tensors: tuple[Tensor, ...]) -> Any:
    with torch.inference_mode(False), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        plain = tuple(
            tensor.clone() for tensor in tensors
        )  # a recording of inference tensors could not be frozen
        return torch.jit.freeze(torch.jit.trace(step, plain, check_trace=False))  # type: ignore[no-untyped-call]


def draw_and_warp() -> None:
    """Draw a line and a car, and carry a picture into another view: tiny cases of the kernels of
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
    for focal_px in (8.0, 80.0):  # the car fills a part of the picture's rows, and all of them
        zoomed = np.array([[focal_px, 0, 8], [0, focal_px, 8], [0, 0, 1]])
        on_boxes(
            depth.shape,
            place_boxes(depth.shape, zoomed, ahead, {"car": T_world_car}, {"car": box}).seen,
        )
    image = np.zeros((side_px, side_px, 3), np.float32)
    trust(image, image, depth)


def gather_and_mix() -> None:
    """Gather the cells of a picture and of a reference, and blend them: tiny cases of the kernels
    of a network.

    Of the precision that is chosen on this processor; where a package is filled, of both: a
    precision costs as much as all other kernels.
    """
    side_px = 16
    image, references = (
        torch.zeros(1, side_px, side_px, 3),
        torch.zeros(1, 1, side_px, side_px, 4, dtype=torch.uint8),
    )
    state = PixelState(image, image, image[:, ::CELL, ::CELL], image, image, image[..., :1])
    for dtype in DTYPES.values() if kernels.fills() else [DTYPES[choose_precision().name]]:
        gather_cells_cpu(image, image[..., :1], image, state, image + 1, dtype)
        gather_beside_cpu(references, image, 1, dtype)
        at2, at4 = (image[:, ::side, ::side].to(dtype) for side in (DETAIL, CELL))
        said = at2[:, None, ..., :1].repeat(1, 1, 1, 1, 18)
        weight = said[..., :4]
        offset = said[..., 4:6]
        correction = said[..., 6:]
        heads = BlendHeads(weight, offsets_cpu(offset[:, 0], at4[..., :2])[:, None], correction)
        likeness_cpu(at4, at4)
        mix_cpu(image, references, heads)
