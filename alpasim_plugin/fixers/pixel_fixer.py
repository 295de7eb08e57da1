"""The generator in pixels as a streaming session: one frame in, one frame out, a history per
camera, every frame guarded.

`fix_frame` is one frame through the network, tensors in and tensors out: source (Eq. 1), flow steps
(Eq. 2), both guards. Its state goes in and comes out, and nothing else is remembered. Several
cameras are a batch. On a GPU it waits for nothing, and is recorded as a graph.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import CapturedFunction, Sizes, download, sizes_of, upload
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import BlockRule, Fixer
from alpasim_plugin.core.types import OPACITY_MEAN, U8, DevicePlanes, Frame
from alpasim_plugin.fixers import guard
from alpasim_plugin.fixers.guard import render_share
from alpasim_plugin.fixers.network.pixel_generator import (
    GRID_PX,
    PixelState,
    Repaired,
    blended,
    content_key,
    noise_key,
)
from alpasim_plugin.fixers.network.reference_blend import (
    FINER_PX,
    HALF,
    BlendHeads,
    enlarged,
    in_bytes,
)
from alpasim_plugin.fixers.network.schedule import from_names, interpolant
from alpasim_plugin.fixers.pixel_network import LoadedGenerator, load_generator
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.trust import trust_facts, trust_sums
from alpasim_plugin.fixers.views import (
    Views,
    check_continues,
    group_views,
    planes_of,
    stacked,
)

FINER_FROM = 4  # how many times smaller an image is seen, at least, where it is weighed anew


class GivenFrame(NamedTuple):
    """One frame of B cameras, and what is known of the frame before."""

    rgb: Tensor  # (B, H, W, 3) uint8
    output: Tensor  # this and the next three: see `PixelState`
    render: Tensor
    hidden: Tensor
    recorded: Tensor
    alpha: Tensor | None = None  # (B, H, W), 0 to 1; None where every pixel is opaque
    maps: Tensor | None = None  # (B, H, W, 3) uint8
    references: Tensor | None = None  # (B, K, H, W, 4) uint8, colour and where it holds
    keys: Tensor | None = None  # (steps, B) int64, of the noise; None: there is none


class FixedFrame(NamedTuple):
    """What `fix_frame` makes of one frame of B cameras."""

    levels: Tensor  # (B, H, W, 3) uint8, the image
    measured: Tensor  # (B, 6), see `guard.measures`
    sums: Tensor  # see `trust_sums`
    output: Tensor  # this and the next three: see `PixelState`
    render: Tensor
    hidden: Tensor
    recorded: Tensor


@dataclass(frozen=True, eq=False)
class DownloadedFrame:
    """What the host knows of one fixed frame of B cameras, fetched in one transfer.

    Attributes:
        images: ``(B, H, W, 3)`` uint8.
        measured: ``(B, 6)``, see `guard.measures`.
        sums: See `trust_sums`.
        pairs: Splats and tiles that each camera's render needed; empty where the host drew it.
        opacity: Mean opacity of each camera's render; empty where the host drew it.
    """

    images: Any
    measured: Any
    sums: Any
    pairs: Sequence[Any]
    opacity: Sequence[Any]

    def has_overflow(self, planes: Sequence[DevicePlanes]) -> bool:
        """Tell whether a device's buffer of splats was too small for a camera's render."""
        fits = [plane.had_room(int(count)) for plane, count in zip(planes, self.pairs, strict=True)]
        return not all(fits)


def device_planes(view: Views, block: Sequence[Frame]) -> list[DevicePlanes]:
    """Return the planes of a view's frames that a device drew; empty where the host did."""
    if isinstance(view.rgb, np.ndarray):
        return []
    return planes_of([block[index] for (index,) in view.index])


def download_frame(outputs: FixedFrame, planes: Sequence[DevicePlanes]) -> DownloadedFrame:
    """Fetch what the host needs of a fixed frame."""
    images, measured, sums, *counts_and_opacity = download(
        outputs.levels,
        outputs.measured,
        outputs.sums,
        *(plane.pairs for plane in planes),
        *(plane.alpha.mean() for plane in planes),
    )
    return DownloadedFrame(
        images=images,
        measured=measured,
        sums=sums,
        pairs=counts_and_opacity[: len(planes)],
        opacity=counts_and_opacity[len(planes) :],
    )


@torch.inference_mode()
def fix_frame(
    generator: LoadedGenerator, settings: PixelFixerSettings, inputs: GivenFrame
) -> FixedFrame:
    """Fix one frame; a large one as a smaller one, whose changes are then enlarged."""
    net = generator.net
    operations = generator.operations
    scale = settings.scale_of(*inputs.rgb.shape[1:3])
    rgb = operations.smaller(inputs.rgb, scale)
    alpha, maps, references = (
        None if part is None else operations.smaller(part, scale)
        for part in (
            None if inputs.alpha is None else inputs.alpha[..., None],
            inputs.maps,
            inputs.references,
        )
    )
    _, height, width, _ = rgb.shape
    state = PixelState(inputs.output, inputs.render, inputs.hidden, inputs.recorded)
    render = in_range(rgb)
    opacity = torch.ones_like(render[..., :1]) if alpha is None else padded(alpha)
    sdmap = torch.full_like(render, -1.0) if maps is None else in_range(maps)
    if references is not None:
        right = render.shape[2] - width
        below = render.shape[1] - height
        references = F.pad(references, (0, 0, 0, right, 0, below))
    transparent = torch.zeros_like(opacity) if settings.holes == "everywhere" else opacity

    def source(draw: int) -> Tensor:
        if inputs.keys is None:
            return render
        return operations.source(render, transparent, inputs.keys[draw])

    def predict(z: Tensor, t: Tensor | None) -> tuple[Repaired, Tensor, PixelState]:
        repaired = net.repair(render, opacity, sdmap, state, z, t, references, operations)
        if scale > 1 and repaired.heads is not None:
            repaired = repaired._replace(heads=enlarged(repaired.heads, scale))
        return repaired, *blended(repaired, render, references, operations)

    repaired, video, after = predict(source(0), None)
    for index, level in enumerate(from_names(settings.steps)[1:], start=1):
        t = render.new_full((len(render),), level.sigma)
        repaired, video, after = predict(interpolant(video, source(index), level.sigma), t)
    change = repaired.image - render
    if settings.keep_render:
        share = render_share(video, render, opacity, sdmap, state.output)
        if share is not None:
            video = torch.lerp(video, render, share * (1 - after.recorded))
            after = after._replace(output=video.clamp(-1, 1))
            change = change * (1 - share)
    visible = slice(None), slice(height), slice(width)
    output = after.output[visible]
    levels, *before = (in_bytes(x[visible]) for x in (after.output, state.output, state.render))
    measured = guard.measures(video[visible], levels, rgb, *before)
    sums = trust_sums(output, after.render[visible], after.recorded[visible])
    if scale > 1:
        levels = _enlarged_frame(generator, inputs, change, repaired.heads, scale)
    return FixedFrame(levels, measured, sums, *after)


def _enlarged_frame(
    generator: LoadedGenerator,
    inputs: GivenFrame,
    change: Tensor,
    heads: BlendHeads | None,
    scale: int,
) -> Tensor:
    """Return the large frame with the change that was found on the smaller one.

    Args:
        generator: Network and operations.
        inputs: The large frame.
        change: What the network added, ``scale`` times smaller.
        heads: Where references are looked up; None without references.
        scale: How many times smaller the network's frame was.
    """
    net = generator.net
    operations = generator.operations
    recorded = inputs.references
    finer = net.finer if scale >= FINER_FROM else None
    if heads is not None and recorded is not None and finer is not None:
        parts = (operations.smaller(part, FINER_PX) for part in (inputs.rgb, recorded))
        heads = heads._replace(finer=finer(*parts, change, heads.weight, scale))
    return operations.enlarge(inputs.rgb, change, recorded, heads, scale)


@lru_cache(maxsize=8)
def _captured(
    generator: LoadedGenerator, settings: PixelFixerSettings, sizes: Sizes
) -> CapturedFunction:
    """Return `fix_frame` as a graph for tensors of some sizes."""
    return CapturedFunction(
        lambda **inputs: fix_frame(generator, settings, GivenFrame(**inputs)),
        sizes,
        generator.device,
    )


@dataclass(frozen=True)
class CameraHistory:
    """The past of one camera."""

    state: PixelState  # of one view
    frames: int  # fixed so far
    t_us: int  # of the last
    raw: Tensor  # (H, W, 3) uint8, the last render


class PixelFixer(Fixer):
    """Repair the frames of one rollout one by one. A step may hold other cameras than the step
    before; each has its own history.

    Args:
        settings: Weights, steps, precision, guard.
        scene_id, seed: Key of the noise, with camera, frame (its index or its content, see
            `PixelFixerSettings.noise`) and pixel.
        device: ``cpu`` or ``cuda``.
        threads: Torch threads of this process; None leaves their number.

    Raises:
        InputError: Settings of another fixer, or weights that are missing or do not fit.
    """

    blocks = BlockRule(1, 1)
    reads_device = True

    def __init__(
        self,
        settings: FixerSettings,
        scene_id: str,
        seed: int = 0,
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        if not isinstance(settings, PixelFixerSettings):
            raise InputError(
                f"{settings.name}: settings of type {type(settings).__name__}",
                "take them from fixer_settings(name)",
            )
        if threads is not None:
            torch.set_num_threads(threads)
        self.settings = settings
        self.scene_id = scene_id
        self.generator = load_generator(settings, device)
        self.trained = self.generator.trained
        step_suffix = f"@{len(settings.steps)}" if len(settings.steps) > 1 else ""
        self.label = f"{settings.name}{step_suffix}, {self.generator.note}, {settings.precision}"
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Drop the history of every camera and use the noise of another seed."""
        self.seed = seed
        self._history: dict[str, CameraHistory] = {}

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix one frame of some cameras and add them to their histories.

        Args:
            block: One frame per camera.
            maps: Semantic maps of the same frames, or empty: nothing is drawn; ignored unless the
                settings say ``uses_map``.

        Returns:
            As many frames, same order, times and cameras. Opacity and depth remain the render's.

        Raises:
            InputError: Frames that do not continue the rollout, or are none (see
                `views.group_views`).
            RendererError: An opacity that is not a number or outside [0, 1].
        """
        out, self._history = self._advance(block, maps, self._history)
        return out

    def advance(
        self, frame: Frame, sdmap: U8 | None, past: CameraHistory | None
    ) -> tuple[Frame, CameraHistory]:
        """Fix one frame of one camera from a given past; the session's own histories are neither
        read nor changed.

        A past is never written to: histories can be forked, kept and continued in any order.

        Args:
            frame: The render.
            sdmap: Its semantic map; None: nothing is drawn.
            past: What an earlier call returned for the frame before; None: the first frame.

        Returns:
            The frame, and the past of the next one.

        Raises:
            InputError, RendererError: See `step`.
        """
        pasts = {} if past is None else {frame.camera: past}
        (fixed,), after = self._advance([frame], () if sdmap is None else [sdmap], pasts)
        return fixed, after[frame.camera]

    def _advance(
        self, block: Sequence[Frame], maps: Sequence[U8], pasts: Mapping[str, CameraHistory]
    ) -> tuple[tuple[Frame, ...], dict[str, CameraHistory]]:
        used_maps = maps if self.settings.uses_map else ()
        views = group_views(block, used_maps, 1, on_device=True)
        for view in views:
            check_continues(view, pasts)
        out = list(block)
        after = dict(pasts)
        for view in views:
            fixed = self._fix(view, block, pasts)
            for camera, (index,), (frame, history) in zip(
                view.cameras, view.index, fixed, strict=True
            ):
                out[index] = frame
                after[camera] = history
        return tuple(out), after

    def _fix(
        self, view: Views, block: Sequence[Frame], histories: Mapping[str, CameraHistory]
    ) -> list[tuple[Frame, CameraHistory]]:
        """Fix the frame of each camera of a view; return it and the camera's past for the next."""
        pasts = [histories.get(camera) for camera in view.cameras]
        inputs = self._inputs(view, pasts)
        outputs = self._run(inputs)
        planes = device_planes(view, block)
        downloaded = download_frame(outputs, planes)
        if downloaded.has_overflow(planes):
            # the splats did not fit the device's buffer: the render itself is incomplete
            return self._fix(*rerendered(view, block), histories)
        fixed = []
        for row, ((index,), past) in enumerate(zip(view.index, pasts, strict=True)):
            frame, state = self._fixed_frame(row, block[index], view.shape, downloaded, outputs)
            if state is None:
                state = self._start(inputs.rgb[row : row + 1])
            count = 1 if past is None else past.frames + 1
            history = CameraHistory(state, count, view.t_us[row][0], inputs.rgb[row])
            fixed.append((frame, history))
        return fixed

    def _inputs(self, view: Views, pasts: Sequence[CameraHistory | None]) -> GivenFrame:
        """Upload one frame of B cameras, and put the cameras' pasts side by side.

        Args:
            view: One frame of each camera, ``T = 1``.
            pasts: The past of each camera, None before its first frame.
        """
        rgb, alpha, maps, references = (
            None if part is None else upload(torch.as_tensor(part[:, 0]), self.generator.device)
            for part in (view.rgb, view.alpha, view.maps, view.references)
        )
        assert rgb is not None, "a view has images"
        states = [
            self._start(rgb[row : row + 1]) if past is None else past.state
            for row, past in enumerate(pasts)
        ]
        counts = [0 if past is None else past.frames for past in pasts]
        return GivenFrame(
            rgb=rgb,
            output=torch.cat([state.output for state in states]),
            render=torch.cat([state.render for state in states]),
            hidden=torch.cat([state.hidden for state in states]),
            recorded=torch.cat([state.recorded for state in states]),
            alpha=alpha,
            maps=maps,
            references=references,
            keys=self._noise_keys(view, rgb, counts),
        )

    def _fixed_frame(
        self,
        row: int,
        frame: Frame,
        shape: tuple[int, int],
        downloaded: DownloadedFrame,
        outputs: FixedFrame,
    ) -> tuple[Frame, PixelState | None]:
        """Make the frame of one camera, guarded.

        Args:
            row: The camera's row in ``downloaded`` and ``outputs``.
            frame: Its render.
            shape: Height and width of the image.
            downloaded: What the host knows of the network's output.
            outputs: The network's output on its device.

        Returns:
            The frame, which is the render with an event where the output fails the guard; and the
            camera's state, None where the output is not finite: it would stay in the state for ever.
        """
        event = guard.failures(downloaded.measured[row : row + 1])[0]
        events = frame.events
        facts = dict(frame.facts)
        if frame.pending is not None:  # nobody has looked at the render yet
            events += guard.render_events(downloaded.measured[row])
        if downloaded.opacity:
            facts[OPACITY_MEAN] = round(float(downloaded.opacity[row]), 5)
        state = PixelState(
            output=outputs.output[row : row + 1],
            render=outputs.render[row : row + 1],
            hidden=outputs.hidden[row : row + 1],
            recorded=outputs.recorded[row : row + 1],
        )
        if event:
            refused = frame.changed(references=(), events=(*events, event), facts=facts)
            return refused, None if event == guard.NAN else state
        scale = self.settings.scale_of(*shape)
        height, width = (-(-side // scale) for side in shape)
        facts |= trust_facts(downloaded.sums[row], height, width)
        image = downloaded.images[row]
        repaired = frame.changed(
            references=(),
            events=events,
            facts=facts,
            rgb=image,
            fixed=(image, outputs.levels[row]),
        )
        return repaired, state

    def _start(self, rgb: Tensor) -> PixelState:
        """Return the state before a first frame ``(1, H, W, 3)``."""
        scale = self.settings.scale_of(*rgb.shape[1:3])
        return self.generator.net.start(in_range(self.generator.operations.smaller(rgb, scale)))

    def _noise_keys(self, view: Views, rgb: Tensor, counts: Sequence[int]) -> Tensor | None:
        """Return the keys of a frame's noise ``(steps, B)``, None where it has none."""
        settings = self.settings
        if settings.holes == "render" or (view.alpha is None and settings.holes != "everywhere"):
            return None
        numbers = counts
        if settings.noise == "content":
            contents = zip(view.t_us, rgb.cpu().numpy(), strict=True)
            numbers = [content_key(t_us[0], image) for t_us, image in contents]
        keys = [
            [
                noise_key(self.scene_id, self.seed, camera, draw, number)
                for camera, number in zip(view.cameras, numbers, strict=True)
            ]
            for draw in range(len(settings.steps))
        ]
        return upload(keys, rgb.device)

    def _run(self, inputs: GivenFrame) -> FixedFrame:
        """Run `fix_frame`, on a GPU as a graph that was recorded for tensors of these sizes."""
        if not self.generator.captured:
            return fix_frame(self.generator, self.settings, inputs)
        tensors = {name: part for name, part in inputs._asdict().items() if part is not None}
        return FixedFrame(*_captured(self.generator, self.settings, sizes_of(tensors))(tensors))


def rerendered(view: Views, block: Sequence[Frame]) -> tuple[Views, Sequence[Frame]]:
    """Re-render the frames whose splat buffer overflowed, with buffers that have room."""
    frames = list(block)
    indices = [index for (index,) in view.index]
    complete = [planes.again() for planes in planes_of([frames[index] for index in indices])]
    for index, planes in zip(indices, complete, strict=True):
        frames[index] = frames[index].changed(on_device=planes)
    rgb, alpha, references = stacked(complete)
    if references is not None:
        view = replace(view, references=references[:, None])
    return replace(view, rgb=rgb[:, None], alpha=alpha[:, None]), frames


def padded(plane: Tensor) -> Tensor:
    """Return planes ``(B, H, W, ...)`` with their edges repeated up to multiples of 16."""
    height, width = plane.shape[1:3]
    below = -height % GRID_PX
    right = -width % GRID_PX
    if not (below or right):
        return plane
    rows = torch.arange(height + below, device=plane.device).clamp_(max=height - 1)
    columns = torch.arange(width + right, device=plane.device).clamp_(max=width - 1)
    return plane[:, rows][:, :, columns]


def in_range(image: Tensor) -> Tensor:
    """Convert images of bytes to [-1, 1], `padded`."""
    return padded(image).float().div_(HALF).sub_(1)
