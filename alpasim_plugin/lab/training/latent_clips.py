"""Training clips as latents of a frozen autoencoder, encoded once and cached on disk.

    FOLDER/DIGEST/SEQUENCE-CONTENT.npy   (clips, 49, N, H/8, W/8) float16: 16 channels each of render, clean frames and map, 1 of the mask

Clips of a sequence start ``stride`` frames apart. Each is used as it is and mirrored; mirrored
clips have class-colour augmentation (see `class_colours`). Each clip is encoded as a stream that
starts at its first frame. DIGEST covers the encoder's weights and the form of the clips, CONTENT
the sequence's arrays.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.clips import GROUP
from alpasim_plugin.block_fixers.sampling import opacity_mask
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_array
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.class_colours import OTHERS, swap_class_colours
from alpasim_plugin.lab.training.clips import to_tensor
from alpasim_plugin.lab.training.pair_store import PairSequence, listed_sizes, pairs_digest

F16 = npt.NDArray[np.float16]
CHANNELS = 16
DECODER = "decoder."  # names of its weights


@dataclass(frozen=True)
class ClipForm:
    """Division of sequences into clips.

    Args:
        latents: N, latents of a clip: ``1 + 4 (N - 1)`` frames.
        stride: Frames between starts.
        class_colour_augmentation: Whether mirrored clips show the map's cars in the colours of
            another class.
    """

    latents: int = 12
    stride: int = 24
    class_colour_augmentation: bool = True

    @property
    def frames(self) -> int:
        """Frames of a clip."""
        return 1 + GROUP * (self.latents - 1)


class LatentClip(NamedTuple):
    """A clip's latents ``(C, N, H/8, W/8)`` float32, and the position of its frames."""

    z_r: Tensor
    z_0: Tensor
    z_map: Tensor
    m: Tensor
    sequence: PairSequence
    start: int
    mirrored: bool

    @property
    def latents(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Render, clean frames, map and mask."""
        return self.z_r, self.z_0, self.z_map, self.m

    def frames(self, end: int, begin: int = 0) -> tuple[Tensor, Tensor]:
        """Return the render ``(3, T, H, W)`` in [-1, 1] and its opacity ``(1, T, H, W)`` of the
        clip's frames ``begin`` to ``end``.
        """
        cut = self.sequence.clip.cut(self.start + begin, end - begin)
        return to_tensor(cut.rgb_input, self.mirrored), (
            to_tensor(cut.opacity[..., None], self.mirrored) + 1
        ) / 2

    def clean(self, end: int, begin: int = 0) -> Tensor:
        """Return the clean frames ``(3, T, H, W)`` in [-1, 1] of the clip's frames ``begin`` to
        ``end``.
        """
        return to_tensor(
            self.sequence.clip.cut(self.start + begin, end - begin).rgb_gt, self.mirrored
        )


class LatentClips:
    """All clips of some sequences, as latents.

    Args:
        sequences: Pairs on disk.
        vae: Frozen autoencoder.
        form: Division into clips.
        folder: Cache of the latents.
        report: Called with the number of sequences done and the total.

    Attributes:
        digest: Of everything the latents depend on: autoencoder, form, and the sequences in their
            order.
        folder: Of the latents of this autoencoder and form.

    Raises:
        InputError: No sequence, one that is too short for a clip, or sequences of several image
            sizes.
    """

    def __init__(
        self,
        sequences: Sequence[PairSequence],
        vae: TinyVAE,
        form: ClipForm,
        folder: Path,
        report: Callable[[int, int], None] | None = None,
    ) -> None:
        if not sequences:
            raise InputError("the pairs: no finished sequence", "run 'simrun train pairs' first")
        if len({sequence.size for sequence in sequences}) > 1:
            raise InputError(
                f"the pairs: images of several sizes, which make no batch: {listed_sizes(sequences)}",
                "choose one with --size WIDTHxHEIGHT",
            )
        encoder = digest(vae, form)
        self.form = form
        self.digest = f"{encoder}-{pairs_digest(sequences)}"
        self.folder = folder / encoder
        self.folder.mkdir(parents=True, exist_ok=True)
        self._where: list[tuple[PairSequence, F16, int]] = []
        for done, sequence in enumerate(sequences):
            array = self._latents(sequence, vae)
            self._where += [(sequence, array, i) for i in range(len(array))]
            if report is not None:
                report(done + 1, len(sequences))

    def __len__(self) -> int:
        return len(self._where)

    def __getitem__(self, index: int) -> LatentClip:
        sequence, array, i = self._where[index]
        z = torch.from_numpy(np.asarray(array[i], dtype=np.float32))
        z_r, z_0, z_map = z[: 3 * CHANNELS].view(3, CHANNELS, *z.shape[1:])
        return LatentClip(
            z_r, z_0, z_map, z[3 * CHANNELS :], sequence, i // 2 * self.form.stride, bool(i % 2)
        )

    def _latents(self, sequence: PairSequence, vae: TinyVAE) -> F16:
        path = self.folder / f"{sequence.name}-{sequence.content[:12]}.npy"
        if not path.exists():
            write_array(path, encode_sequence(sequence, vae, self.form))
        return np.asarray(np.load(path, mmap_mode="r"))


def encode_sequence(sequence: PairSequence, vae: TinyVAE, form: ClipForm) -> F16:
    """Encode all clips of a sequence ``(clips, 49, N, H/8, W/8)``: every start, unmirrored, then
    mirrored.
    """
    starts = range(0, len(sequence.clip) - form.frames + 1, form.stride)
    if not starts:
        raise InputError(
            f"{sequence.folder}: {len(sequence.clip)} frames, a clip has {form.frames}",
            "make longer sequences, or train on fewer latents",
        )
    return np.stack(
        [
            _encode(sequence, vae, start, form, mirrored)
            for start in starts
            for mirrored in (False, True)
        ]
    )


@torch.inference_mode()
def _encode(
    sequence: PairSequence, vae: TinyVAE, start: int, form: ClipForm, mirrored: bool
) -> F16:
    cut = sequence.clip.cut(start, form.frames)
    sdmap = cut.sdmap
    if mirrored and form.class_colour_augmentation:
        rng = stream(sequence.name, 0, "training.map_colours", start)
        sdmap = swap_class_colours(sdmap, OTHERS[int(rng.integers(len(OTHERS)))])
    videos = torch.stack([to_tensor(x, mirrored) for x in (cut.rgb_input, cut.rgb_gt, sdmap)])
    mask = opacity_mask((to_tensor(cut.opacity[..., None], mirrored)[None] + 1) / 2)
    z = vae.encode(videos)
    return np.asarray(torch.cat([z.flatten(0, 1), mask[0]]).half().numpy())


def digest(vae: TinyVAE, form: ClipForm) -> str:
    """Return a digest of what latents depend on: the encoder with its statistics, and the form of
    the clips; not the decoder.
    """
    out = hashlib.blake2b(json.dumps(asdict(form)).encode(), digest_size=8)
    for key, value in sorted(vae.state_dict().items()):
        if key.startswith(DECODER):
            continue
        out.update(key.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    return out.hexdigest()
