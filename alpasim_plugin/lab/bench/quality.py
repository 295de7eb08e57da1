"""Open-loop quality: a fixer over a recorded clip, block by block as in the closed loop, compared
with the ground truth.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.core.parts import PartSpec
from alpasim_plugin.core.types import I64, U8, Frame
from alpasim_plugin.fixers.refine import StreamStats, refine_frames
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.lab.bench.colour_video_vdp import ColourVideoVDP
from alpasim_plugin.lab.bench.map_error import MapShift
from alpasim_plugin.lab.training.reference_store import SequenceReferences
from alpasim_plugin.lab.video_metrics import clip_quality
from alpasim_plugin.lab.video_metrics.facts import JOD
from alpasim_plugin.lab.video_metrics.perceptual import ImageDistance
from alpasim_plugin.lab.video_metrics.summary import TRUTH

RAW = "3dgs"  # the variant of the unfixed render
VERSION = 3  # of what a row holds and how it is measured; part of its key
CAMERA = "camera"
DIGITS = 7  # significant, of stored values


JOD_EVERY = 20  # frames: the metric takes ten times as long as a fixer


@dataclass(frozen=True)
class QualityClip:
    """A degraded render with the other inputs of a fixer, and the ground truth; ``T`` frames of one
    camera.
    """

    name: str
    identity: Mapping[str, Any]  # distinguishes this clip from others of the same name
    render: U8  # (T, H, W, 3)
    truth: U8  # (T, H, W, 3)
    opacity: U8  # (T, H, W), 255 is opaque
    sdmap: U8  # (T, H, W, 3)
    t_us: I64  # (T,)
    recorded: SequenceReferences | None = None

    def first(self, frames: int) -> QualityClip:
        """Return the clip's first frames, all of them where it has fewer."""
        return replace(
            self,
            **{
                name: getattr(self, name)[:frames]
                for name in ("render", "truth", "opacity", "sdmap", "t_us")
            },
        )

    def references(self, count: int, past: bool = False) -> Iterator[tuple[U8, ...]]:
        """Yield the references of every frame, at most ``count`` each."""
        if self.recorded is None or not count:
            yield from ((),) * len(self.t_us)
        else:
            yield from self.recorded.warped(len(self.t_us), count, past)


@dataclass(frozen=True)
class Variant:
    """One row of the table: the render as it is (``3dgs``), the truth, or a fixer under a label."""

    label: str
    spec: PartSpec | None = None  # None for 3dgs and the truth
    map_shift: MapShift | None = None  # None: the map as it is

    def __post_init__(self) -> None:
        if self.spec is None and self.label not in (RAW, TRUTH):
            raise InputError(
                f"variant {self.label!r}: no fixer", f"name a fixer, or one of {RAW}, {TRUTH}"
            )

    def content(self) -> dict[str, Any]:
        """Return everything that determines its images."""
        shift = {} if self.map_shift is None else {"map_shift": self.map_shift.label}
        return {"label": self.label, "fixer": self.spec and self.spec.digest, **shift}


@dataclass(frozen=True)
class VariantResult:
    """Output of a variant on a clip.

    Args:
        video: ``(T, H, W, 3)``.
        ms_per_frame: Of every block, the first included; empty where no fixer ran.
        events: Frames that the guard replaced by the raw ones, by event.
    """

    video: U8
    ms_per_frame: tuple[float, ...]
    events: Mapping[str, int]


def row_key(
    clip: QualityClip, variant: Variant, seed: int, device: str, networks: Mapping[str, str]
) -> str:
    """Return the digest of everything that determines a row, except the speed of the machine.

    Args:
        clip: Already cut to length.
        variant: With the digests of its weights.
        seed: Of the fixer's noise.
        device: Where the fixer computes.
        networks: Perceptual distances by name, each with what identifies its weights.
    """
    facts = [
        VERSION,
        clip.name,
        len(clip.t_us),
        dict(clip.identity),
        variant.content(),
        seed,
        device,
        dict(networks),
    ]
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()


def run_variant(clip: QualityClip, variant: Variant, fixer: Fixer | None) -> VariantResult:
    """Run a variant over a clip.

    Args:
        clip: The clip.
        variant: Which.
        fixer: A session at the start of a rollout, for variants that are fixers.

    Raises:
        InputError: A fixer that is missing, or given where none runs.
    """
    if (fixer is None) != (variant.spec is None):
        raise InputError(
            f"variant {variant.label!r}: a missing or superfluous fixer",
            "give a session exactly for a fixer's variant",
        )
    if (
        fixer is None
        or variant.spec is None
        or not isinstance(variant.spec.settings, FixerSettings)
    ):
        return VariantResult(
            np.array(clip.truth if variant.label == TRUTH else clip.render), (), {}
        )
    tally, frames = StreamStats(), []
    for block in refine_frames(fixer_input(clip, variant.spec.settings), fixer):
        tally.add(block)
        frames += [frame.rgb for frame in block.fixed]
    return VariantResult(np.stack(frames), tuple(tally.ms_per_frame), dict(tally.events))


def measure(
    clip: QualityClip,
    variant: Variant,
    result: VariantResult,
    seed: int,
    networks: Mapping[str, ImageDistance],
    vdp: ColourVideoVDP | None = None,
) -> dict[str, Any]:
    """Return the row of one clip under one variant, as `alpasim_plugin.lab.video_metrics.summary`
    takes it.
    """
    found = clip_quality(
        result.video, None if variant.label == TRUTH else clip.truth, networks, clip.sdmap
    )
    values = dict(found.means)
    if vdp is not None and variant.label != TRUTH:
        values[JOD] = float(vdp.jod(result.video[::JOD_EVERY], clip.truth[::JOD_EVERY]).mean())
    return {
        "arm": variant.label,
        "clip": clip.name,
        "seed": seed,
        "frames": len(clip.t_us),
        "size": list(clip.truth.shape[1:3]),
        "values": values,
        "identical": found.identical,
        "events": dict(result.events),
        # The first block is shorter and opens the history; where there are more, it does not count.
        "ms_per_frame": [round(ms, 4) for ms in result.ms_per_frame[1:] or result.ms_per_frame],
        "series": {
            name: [float(f"{v:.{DIGITS}g}") for v in values]
            for name, values in found.series.items()
        },
    }


def fixer_input(clip: QualityClip, settings: FixerSettings) -> Iterator[tuple[Frame, U8 | None]]:
    """Yield every frame of a clip as a fixer gets it, with its map where the settings use one."""
    recorded = clip.references(settings.references, settings.recording == "past")
    for i, (t_us, references) in enumerate(zip(clip.t_us, recorded, strict=True)):
        alpha = clip.opacity[i].astype(np.float32) / np.float32(255)
        frame = Frame(int(t_us), CAMERA, np.array(clip.render[i]), alpha, references=references)
        yield frame, np.array(clip.sdmap[i]) if settings.uses_map else None
