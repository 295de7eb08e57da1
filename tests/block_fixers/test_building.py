"""What building networks costs a process that only wants to run them."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import sys
import torch
from alpasim_plugin.fixers.network import CosmosCausalDiT, DiTSizes, TinyDecoder, TinyVAE, WanVAE
from alpasim_plugin.block_fixers.sizes import initial_weights
from alpasim_plugin.block_fixers.wan_vae_blocks import WanLayout
TinyVAE.from_state_dict(TinyVAE.random().state_dict())
WanVAE.random(WanLayout.of_base(4)), TinyDecoder.random(16, (4, 4, 4, 4))
CosmosCausalDiT.from_state_dict(initial_weights(DiTSizes(16, 1, 8, 16, 2, 2, 2), 0)).folded(1000.0)
print("torch._dynamo" in sys.modules)
"""


@pytest.mark.slow
def test_building_networks_does_not_load_the_compiler(repo):
    """It would take seconds, and happens when arithmetic is done on the meta device."""
    out = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, cwd=repo
    )
    assert out.stdout.strip() == "False"
