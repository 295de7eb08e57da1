"""Latents of styled targets: clean frames in another appearance by the formulas, encoded when they
are first drawn.

    FOLDER/appearance-VERSION/SEQUENCE-CONTENT-START-SCENE.npy   (styles, 2, 16, N, H/8, W/8) float16: as it is and mirrored

Rendering the depth takes most of the time, so a clip is encoded in all styles at once.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.settings import STYLES
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.atomic import write_array
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import U8
from alpasim_plugin.lab.training.appearance import VERSION
from alpasim_plugin.lab.training.clips import to_tensor
from alpasim_plugin.lab.training.latent_clips import F16, LatentClip, LatentClips
from alpasim_plugin.lab.training.seen_scene import restyle_video, scene_of, seen_frames

FORMULAS = STYLES[1:]  # the clear style's latents are the clip's own


class StyledLatents:
    """Targets of clips in every style.

    Args:
        clips: Training latents.
        vae: Their autoencoder, frozen.
        scenes: ROOT of the scenes behind the pairs, ROOT/SPLIT/NAME.yaml.

    Raises:
        InputError: No folder of scenes.
    """

    def __init__(self, clips: LatentClips, vae: TinyVAE, scenes: Path | None) -> None:
        if scenes is None or not scenes.is_dir():
            found = "no folder of scenes" if scenes is None else f"{scenes} is no folder"
            raise InputError(
                f"--scenes: {found}",
                "name the scenes of the pairs: fog, lamps and snow need their depth",
            )
        self.form, self.vae, self.scenes = clips.form, vae, scenes
        self._folder = clips.folder / f"appearance-{VERSION}"
        self._folder.mkdir(parents=True, exist_ok=True)

    def target(self, clip: LatentClip, style: str) -> Tensor:
        """Return the latents ``(16, N, H/8, W/8)`` of a clip's clean frames in a style.

        Raises:
            InputError: No such style, no scene, or one that the pairs were not rendered from.
        """
        if style == STYLES[0]:
            return clip.z_0
        if style not in FORMULAS:
            raise InputError(
                f"style {style!r}: no such style",
                f"choose one of {', '.join(STYLES)}",
            )
        stored = self._of(clip)[FORMULAS.index(style), int(clip.mirrored)]
        return torch.from_numpy(np.asarray(stored, dtype=np.float32))

    def _of(self, clip: LatentClip) -> F16:
        sequence = clip.sequence
        name = f"{sequence.name}-{sequence.content[:12]}-{clip.start}-{str(sequence.info.get('scene_hash'))[:12]}.npy"
        path = self._folder / name
        if not path.exists():
            write_array(path, self._encode(clip))
        return np.asarray(np.load(path, mmap_mode="r"))

    @torch.inference_mode()
    def _encode(self, clip: LatentClip) -> F16:
        sequence, frames = clip.sequence, self.form.frames
        seen = seen_frames(sequence, scene_of(sequence, self.scenes), clip.start, frames)
        video: U8 = sequence.clip.cut(clip.start, frames).rgb_gt
        made = [
            restyle_video(video, seen, style, str(sequence.info.get("scene_id", sequence.name)))
            for style in FORMULAS
        ]
        both = torch.stack(
            [torch.stack([to_tensor(v, mirrored) for mirrored in (False, True)]) for v in made]
        )
        z = self.vae.encode(both.flatten(0, 1))
        return np.asarray(z.view(*both.shape[:2], *z.shape[1:]).half().numpy())
