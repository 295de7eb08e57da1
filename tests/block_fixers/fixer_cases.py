"""Small fixers and clips shared by the tests of the streaming fixer."""

from dataclasses import dataclass

from alpasim_plugin.block_fixers.onefixer import OneFixer
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.types import U8, Frame
from alpasim_plugin.fixers import fixer_settings
from tests.block_fixers.stand_in import save_stand_in

SMALL_DIT = (
    "weights.bundle=null",
    "history=last-forward",
    "holes=render",
    "dit.width=24",
    "dit.blocks=2",
    "dit.head_width=12",
    "dit.mlp_width=40",
    "dit.adaln_rank=5",
    "dit.text_width=7",
    "dit.context_width=9",
)


@dataclass(frozen=True)
class Recorded:
    """Frames of one camera and their maps."""

    list_of_frames: list[Frame]
    maps: list[U8]

    def frames(self):
        return self.list_of_frames


def small_settings(*overrides, name="onefixer-dit-tiny"):
    settings = fixer_settings(name, (*SMALL_DIT, *overrides))
    assert isinstance(settings, OneFixerSettings)
    return settings


def busy_settings(folder, *overrides):
    """Return settings whose weights make every layer count, which an identity's do not."""
    settings = small_settings("holes=noise", *overrides)
    must_match = (
        settings.block_latents,
        settings.decoder.kind,
        settings.render_input,
        settings.opacity_input,
    )
    path = folder / f"blocks_of_{'_'.join(map(str, must_match))}.safetensors"
    if not path.exists():
        save_stand_in(path, settings)
    return small_settings("holes=noise", *overrides, f"weights.bundle={path}")


def fixer(settings, scene_id="scene", seed=0):
    return OneFixer(settings, scene_id, seed)


def run_blocks(fixer, frames, maps):
    """Step through a clip of one camera in whole blocks; the last may be short."""
    out = []
    block = 0
    while len(out) < len(frames):
        cut = slice(len(out), len(out) + fixer.blocks.frames(block))
        out += fixer.step(frames[cut], maps[cut])
        block += 1
    return out


def record_videos(fixer):
    """Return a list that fills with what the pipeline decodes, before rounding."""
    seen = []
    run = fixer.pipeline.run

    def spy(*args):
        video, state = run(*args)
        seen.append(video)
        return video, state

    fixer.pipeline.run = spy
    return seen
