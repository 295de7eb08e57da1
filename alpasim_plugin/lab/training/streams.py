"""Streams of consecutive training frames for a recurrent fixer, as a pure function of the update's
number.

A batch has slots. A slot's timeline is cut into episodes of equal length, staggered over the slots;
everything of an episode is drawn from the stream keyed by (seed, slot, episode). So any update can
be made alone, in any order, and a run that resumes needs nothing but its number. Within an episode
frames follow one another, also from one update to the next; a sequence that ends is played back
from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64, I64, U8, Bool
from alpasim_plugin.lab.training.class_colours import OTHERS, swap_class_colours
from alpasim_plugin.lab.training.drive_pairs import DRIVE
from alpasim_plugin.lab.training.episode_references import (
    ReferenceDraw,
    draw_references,
    pair_references,
    road_users,
    smooth_field,
    video_references,
)
from alpasim_plugin.lab.training.lost_resolution import LostResolution, draw_lost_resolution
from alpasim_plugin.lab.training.map_errors import MapError, draw_map_error, with_error
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence, pairs_digest

KINDS = ("pairs", "identity", "video", "damaged_video")
SIDE = 16  # crops are multiples of it
# Probability of each augmentation of an episode: played backward, every second frame, mirrored,
# photometric, class colours of the map.
P_REVERSE = 0.25
P_STRIDE_2 = 0.2
P_FLIP = 0.5
P_PHOTOMETRIC = 0.7
P_CLASS_COLOURS = 0.25
# Of a photometric augmentation
GAIN = (0.6, 1.15)
CHANNEL_GAIN = (0.9, 1.1)
GAMMA = (0.85, 1.2)
# A render is moved this far to the truth: the better a fit, the more every change harms
P_BETTER = 0.15
BETTER = (0.2, 0.95)
# an episode of pairs shows a recorded street, where there are any: few drives say more of real fits
# than their number
P_DRIVE = 0.3
P_GREY = 0.06  # recordings without colour
# A long fit of photographs is sharp, and wrong by place: surfaces lie beside where they are, and
# edges double where views disagree. Such a render is the truth, moved by a smooth field; where it
# doubles, the mean of two.
P_MOVED = 0.2
MOVED_PX = (0.3, 2.5)
P_DOUBLED = 0.5
# of an episode of damaged video: `training.lost_resolution` in the place of `training.video_damage`
P_LOST_RESOLUTION = 0.5
# Undamaged frames get detail that the corpus has little of, in both places: a camera's sharpening
# and its noise. Both are to be kept.
P_DETAIL = 0.5
SHARPNESS = (0.0, 1.5)  # of the difference from a blur of 1 pixel
GRAIN = (0.0, 0.05)  # standard deviation, levels of [-1, 1]


@dataclass(frozen=True)
class StreamShares:
    """Chance of each kind of an episode.

    Attributes:
        pairs: Degraded and clean renders.
        identity: The clean render in both places, opaque: a perfect render stays as it is.
        video: Recorded video in both places, opaque, without a map.
        damaged_video: Recorded video with synthetic damage (`training.video_damage`,
            `training.lost_resolution`), without a map.

    Raises:
        InputError: A negative share, or shares that do not add up to one.
    """

    pairs: float = 0.78
    identity: float = 0.11
    video: float = 0.01
    damaged_video: float = 0.10

    def __post_init__(self) -> None:
        values = [getattr(self, f.name) for f in fields(self)]
        if min(values) < 0 or abs(sum(values) - 1) > 1e-9:
            raise InputError(
                f"shares {values}: they add up to {sum(values):g}",
                "give shares of at least 0 that add up to 1",
            )


@dataclass(frozen=True)
class StreamBatch:
    """The frames of one update: B slots, T frames in order of time, crops of ``h x w`` pixels;
    float32.

    Attributes:
        render: ``(B, T, 3, h, w)`` in [-1, 1], degraded.
        opacity: ``(B, T, 1, h, w)`` in [0, 1], of the render; 1 where there is none to know.
        map: ``(B, T, 3, h, w)`` in [-1, 1], semantic map; -1 where it is black, or where there is
            none.
        target: ``(B, T, 3, h, w)`` in [-1, 1], clean.
        fresh: ``(B,)`` bool; false where the first frame follows the last one of the update before.
        kind: ``(B,)`` int64, index into `KINDS`.
        references: ``(B, T, K, h, w, 4)`` recorded frames in the view, colour in [-1, 1] and where
            they hold, 0 to 1; all 0 where there is none.
        road_users: ``(B, T, 1, h, w)`` bool; what shows a road user's box.
    """

    render: Tensor
    opacity: Tensor
    map: Tensor
    target: Tensor
    fresh: Tensor
    kind: Tensor
    references: Tensor
    road_users: Tensor


@dataclass(frozen=True)
class Episode:
    """What a slot shows during one episode.

    Attributes:
        kind: Index into `KINDS`.
        sequence: Which one.
        start: Its first frame.
        step: Frames from one to the next, negative backward.
        top, left: Corner of the crop, pixels.
        flip: Whether it is mirrored.
        levels: ``(256, 3)`` float32 in [-1, 1], what an image's levels become, by channel.
        car_class: Class in whose colours the map's cars are shown; None leaves them.
        sharpness, grain: Of the detail that undamaged frames get; zero leaves them.
        key: Of the grain's random stream.
        lost: In the place of the damage that the sequence was recorded with; None keeps that one.
        references: Which recorded frames are there, and how wrong they are.
        better: How far a render is moved to the truth, 0 to 1.
        moved_px: By how much the truth is moved where it stands for the render; 0 shows the render.
        doubled: Whether it is moved in two ways at once.
        grey: Whether all is without colour.
        map_error: What is wrong with the map.
        other: Of which sequence the map is, where it is that of another.
    """

    kind: int
    sequence: PairSequence
    start: int
    step: int
    top: int
    left: int
    flip: bool
    levels: F32
    car_class: str | None
    sharpness: float
    grain: float
    key: str
    lost: LostResolution | None
    references: ReferenceDraw
    better: float
    moved_px: float
    doubled: bool
    grey: bool
    map_error: MapError
    other: PairSequence


class TrainingStreams:
    """Training batches of consecutive frames.

    Args:
        pairs: Folder that ``simrun train pairs`` wrote.
        video: Folder that ``simrun train video`` wrote; None with shares without video.
        seed: Of all draws.
        batch: Slots.
        frames: Frames of each slot in an update.
        crop: Height and width of the crops, pixels, multiples of 16.
        episode: Updates of an episode.
        shares: Chance of each kind.
        split: Of the pairs and the videos.
        count: Only the first sequences of pairs, in order of their numbers; None for all that are
            finished now.

    Raises:
        InputError: No finished sequence, a frame smaller than the crop, or a number that makes no
            batch.
    """

    def __init__(
        self,
        pairs: Path | str,
        video: Path | str | None = None,
        *,
        seed: int = 0,
        batch: int = 6,
        frames: int = 4,
        crop: tuple[int, int] = (96, 128),
        episode: int = 12,
        shares: StreamShares | None = None,
        split: str = "train",
        count: int | None = None,
    ) -> None:
        self.shares = shares or StreamShares()
        self.seed, self.batch, self.frames, self.crop, self.episode = (
            seed,
            batch,
            frames,
            crop,
            episode,
        )
        if min(batch, frames, episode, *crop) < 1 or crop[0] % SIDE or crop[1] % SIDE:
            raise InputError(
                f"batch {batch}, frames {frames}, episode {episode}, crop {crop}: no batch",
                f"give at least one of each, and a crop in multiples of {SIDE}",
            )
        self.pairs = _in_order(PairDataset(pairs, split).sequences)[:count]
        self.drives = tuple(
            sequence for sequence in self.pairs if sequence.info.get("family") == DRIVE
        )
        needs_video = self.shares.video + self.shares.damaged_video > 0
        if needs_video and video is None:
            raise InputError(
                f"{self.shares}: no folder of videos",
                "make one with 'simrun train video', or give them no share",
            )
        self.videos = (
            PairDataset(video, split).sequences if needs_video and video is not None else ()
        )
        for sequence in (*self.pairs, *self.videos):
            size = sequence.clip.rgb_gt.shape[1:3]
            if size[0] < crop[0] or size[1] < crop[1]:
                raise InputError(
                    f"{sequence.folder}: frames of {size[1]}x{size[0]}, smaller than the crop {crop[1]}x{crop[0]}",
                    "crop less",
                )

    def update(self, i: int, slots: Sequence[int] | None = None) -> StreamBatch:
        """Return the batch of update ``i``, counted from 0; of some slots, or of all."""
        chosen = range(self.batch) if slots is None else slots
        episodes = [self.episode_of(slot, i) for slot in chosen]
        samples = [self._show(episode, index) for episode, index in episodes]
        render, opacity, sdmap, target, references, users = (
            torch.from_numpy(np.stack(arrays)) for arrays in zip(*samples, strict=True)
        )
        fresh = torch.tensor([index == 0 or i == 0 for _, index in episodes])
        return StreamBatch(
            render,
            opacity,
            sdmap,
            target,
            fresh,
            torch.tensor([episode.kind for episode, _ in episodes]),
            references,
            users,
        )

    def episode_of(self, slot: int, i: int) -> tuple[Episode, int]:
        """Return what a slot shows at update ``i``, and how many updates of the episode came
        before.
        """
        number, updates_before = divmod(i + slot * self.episode // self.batch, self.episode)
        return self._draw(slot, number), updates_before

    def facts(self) -> dict[str, Any]:
        """Return what the batches depend on, for a run's card and the refusal of other data."""
        return {
            "pairs": len(self.pairs),
            "pairs_digest": pairs_digest(self.pairs),
            "videos": len(self.videos),
            "videos_digest": pairs_digest(self.videos),
            "shares": asdict(self.shares),
            "seed": self.seed,
            "batch": self.batch,
            "frames": self.frames,
            "crop": list(self.crop),
            "episode": self.episode,
        }

    def _draw(self, slot: int, number: int) -> Episode:
        rng = stream("training", self.seed, f"streams.{slot}", number)
        kind = int(rng.choice(len(KINDS), p=[getattr(self.shares, name) for name in KINDS]))
        sequences = self.videos if KINDS[kind] in ("video", "damaged_video") else self.pairs
        if KINDS[kind] == "pairs" and self.drives and rng.random() < P_DRIVE:
            sequences = self.drives
        sequence = sequences[int(rng.integers(len(sequences)))]
        length, height, width = sequence.clip.rgb_gt.shape[:3]
        start, top, left = (
            int(rng.integers(n))
            for n in (length, height - self.crop[0] + 1, width - self.crop[1] + 1)
        )
        chances = (P_REVERSE, P_STRIDE_2, P_FLIP, P_PHOTOMETRIC, P_CLASS_COLOURS)
        reverse, stride_2, flip, photometric, class_colours = (rng.random(5) < chances).tolist()
        gain = rng.uniform(*GAIN)
        channels = rng.uniform(*CHANNEL_GAIN, 3)
        gamma = rng.uniform(*GAMMA)
        other = OTHERS[int(rng.integers(len(OTHERS)))]
        levels = _levels(gain * channels, gamma) if photometric else _levels(np.ones(3), 1.0)
        step = (-1 if reverse else 1) * (2 if stride_2 else 1)
        detailed = rng.random() < P_DETAIL
        sharpness, grain = (
            float(rng.uniform(*span)) if detailed else 0.0 for span in (SHARPNESS, GRAIN)
        )
        key = f"streams.{slot}.{number}"
        loses = KINDS[kind] == "damaged_video" and rng.random() < P_LOST_RESOLUTION
        lost = draw_lost_resolution(rng, *self.crop) if loses else None
        references = draw_references(rng)
        better = float(rng.uniform(*BETTER)) * (rng.random() < P_BETTER)
        moved_px = float(rng.uniform(*MOVED_PX)) * (rng.random() < P_MOVED)
        doubled = bool(rng.random() < P_DOUBLED)
        without_colour = rng.random() < P_GREY
        car_class = other if class_colours else None
        map_error = draw_map_error(rng)
        elsewhere = self.pairs[int(rng.integers(len(self.pairs)))]
        return Episode(
            kind,
            sequence,
            start,
            step,
            top,
            left,
            flip,
            levels,
            car_class,
            sharpness,
            grain,
            key,
            lost,
            references,
            better,
            moved_px,
            doubled,
            without_colour,
            map_error,
            elsewhere,
        )

    def _show(self, episode: Episode, update: int) -> tuple[F32, F32, F32, F32, F32, Bool]:
        """Return render ``(T, 3, h, w)``, opacity ``(T, 1, h, w)``, map, target, references and
        road users of an episode's update.
        """
        clip = episode.sequence.clip
        kind = KINDS[episode.kind]
        index = there_and_back(
            episode.start + episode.step * (update * self.frames + np.arange(self.frames)),
            len(clip),
        )
        columns = slice(episode.left, episode.left + self.crop[1])
        rows = slice(episode.top, episode.top + self.crop[0])

        def cut(channel: U8) -> U8:
            out = np.stack([channel[t, rows, columns] for t in index])
            return out[:, :, ::-1] if episode.flip else out

        target = _lit(cut(clip.rgb_gt), episode.levels)
        damaged = kind in ("pairs", "damaged_video")
        if not damaged:
            random = stream("training", self.seed, f"{episode.key}.grain", update)
            target = _detailed(target, episode.sharpness, episode.grain, random)
        render = target
        if damaged and not episode.lost:
            render = _lit(cut(clip.rgb_input), episode.levels)
        opacity: F32 = np.ones((len(index), 1, *self.crop), dtype=np.float32)
        if episode.lost:
            render = episode.lost.apply(target)
            opacity = opacity * episode.lost.opacity
        elif damaged:
            opacity = cut(clip.opacity)[:, None].astype(np.float32) / np.float32(255)
        if episode.moved_px and kind == "pairs":
            render = _moved(target, episode, stream("training", self.seed, f"{episode.key}.moved"))
            opacity = np.ones_like(opacity)
        elif episode.sequence not in self.drives:  # a real fit is never exact where it looks so
            render = render + np.float32(episode.better) * (target - render)
        reference_crop = episode.references, index, rows, columns
        if kind in ("pairs", "identity"):
            recorded = pair_references(episode.sequence, *reference_crop)
        else:
            recorded = video_references(clip, *reference_crop)
        references = _lit_references(recorded, episode)
        if episode.grey:
            render = _grey(render, 1)
            target = _grey(target, 1)
            references[..., :3] = _grey(references[..., :3], -1)
        other = episode.other.clip.sdmap if episode.map_error.kind == "other" else clip.sdmap
        sdmap = other if other.shape == clip.sdmap.shape else clip.sdmap
        users = road_users(episode.sequence, index, rows, columns)[:, None]
        if episode.flip:
            users = users[..., ::-1].copy()
        return (
            render,
            opacity,
            self._map(with_error(cut(sdmap), episode.map_error), episode),
            target,
            references,
            users,
        )

    def _map(self, sdmap: U8, episode: Episode) -> F32:
        map_frames = swap_class_colours(sdmap, episode.car_class) if episode.car_class else sdmap
        return np.ascontiguousarray(
            map_frames.transpose(0, 3, 1, 2).astype(np.float32) / np.float32(127.5) - 1
        )


def _levels(gain: F64, gamma: float) -> F32:
    """Return what the 256 levels of a channel become ``(256, 3)``, -1 to 1."""
    grey = np.arange(256)[:, None] / 255
    colours = np.clip(gain * grey**gamma, 0, 1)
    return (colours * 2 - 1).astype(np.float32)


def there_and_back(index: I64, length: int) -> I64:
    """Reflect frame numbers at both ends of a sequence, so that neighbours stay neighbours.

    Example:
        >>> there_and_back(np.arange(-2, 6), 4).tolist()
        [2, 1, 0, 1, 2, 3, 2, 1]
    """
    period = max(2 * (length - 1), 1)
    folded = np.abs(index) % period
    return np.asarray(np.minimum(folded, period - folded) if length > 1 else np.zeros_like(index))


def _lit(frames: U8, levels: F32) -> F32:
    """Map frames ``(T, h, w, 3)`` to ``(T, 3, h, w)`` by a table of levels."""
    return np.stack([levels[frames[..., c], c] for c in range(3)], axis=1)


def _lit_references(references: U8, episode: Episode) -> F32:
    """Map references ``(T, K, h, w, 4)`` to [-1, 1], with the episode's levels and each one's own
    gain; the last channel to 0..1.
    """
    flipped = references[:, :, :, ::-1] if episode.flip else references
    out = np.empty(flipped.shape, dtype=np.float32)
    for c in range(3):
        out[..., c] = episode.levels[flipped[..., c], c]
    gains = episode.references.gains.astype(np.float32)[None, :, None, None]
    out[..., :3] = np.clip((out[..., :3] + 1) * gains - 1, -1, 1)
    out[..., 3] = flipped[..., 3] / np.float32(255)
    return out * (out[..., 3:] > 0)


def _moved(frames: F32, episode: Episode, rng: np.random.Generator) -> F32:
    """Move what frames ``(T, 3, h, w)`` show by smooth fields, one or the mean of two."""
    height, width = frames.shape[2:]
    place = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
    fields = [
        place + smooth_field(rng, (height, width), episode.moved_px)
        for _ in range(1 + episode.doubled)
    ]
    moved = [
        [
            cv2.remap(
                frame.transpose(1, 2, 0),
                shift,
                None,
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REFLECT_101,
            )
            for frame in frames
        ]
        for shift in fields
    ]
    return np.clip(np.mean(moved, axis=0, dtype=np.float32), -1, 1).transpose(0, 3, 1, 2)


def _grey(frames: F32, channels: int) -> F32:
    """Replace the colours by their mean."""
    return np.broadcast_to(frames.mean(axis=channels, keepdims=True), frames.shape).copy()


def _detailed(frames: F32, sharpness: float, grain: float, rng: np.random.Generator) -> F32:
    """Sharpen frames ``(T, 3, h, w)`` in [-1, 1] and add independent noise to every value."""
    if not sharpness and not grain:
        return frames
    blurred = np.stack(
        [[cv2.GaussianBlur(channel, (0, 0), 1.0) for channel in frame] for frame in frames]
    )
    noise = np.float32(grain) * rng.standard_normal(frames.shape, np.float32)
    return np.clip(frames + np.float32(sharpness) * (frames - blurred) + noise, -1, 1)


def _in_order(sequences: Sequence[PairSequence]) -> tuple[PairSequence, ...]:
    """Return sequences by their number, the order in which they are made: the first few have every
    family.
    """
    return tuple(sorted(sequences, key=lambda s: (s.name.rsplit("_", 1)[-1], s.name)))
