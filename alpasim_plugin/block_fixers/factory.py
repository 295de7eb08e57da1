"""The factory of the block generators: what is known of one without loading its networks, and how a
session is made.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.fixers.bundle import FixerFactory

if TYPE_CHECKING:
    from alpasim_plugin.block_fixers.onefixer import OneFixer


def _session(
    settings: OneFixerSettings, scene_id: str, seed: int, device: str, threads: int | None
) -> OneFixer:
    from alpasim_plugin.block_fixers.onefixer import OneFixer  # loads torch

    return OneFixer(settings, scene_id, seed, device, threads)


blocks = FixerFactory(
    OneFixerSettings,
    _session,
    {
        "onefixer-dit-tiny": "one-step causal transformer on latents, block by block, for a CPU at 256x144",
        "onefixer-dit-s": "one-step causal transformer on latents, block by block, for a small GPU",
        "onefixer-2b": "one-step causal transformer at the size of OmniDreams single view; needs its weights",
        "omnidreams": "variant of the comparison: diffusion forcing from the mixed source; to be trained",
        "self-forcing": "variant of the comparison: distilled on its own rollouts; to be trained",
        "one-forcing": "variant of the comparison: Self-Forcing with an adversarial head; to be trained",
        "artifixer-pre": "variant of the comparison: opacity in every block, long blocks; to be trained",
        "artifixer": "variant of the comparison: artifixer-pre, distilled; to be trained",
    },
)
