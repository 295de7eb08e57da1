"""Fixers: networks that restore rendered frames, conditioned on a semantic map."""

from alpasim_plugin.fixers import identity as identity
from alpasim_plugin.fixers import onefixer as onefixer
from alpasim_plugin.fixers.base import FIXERS, BlockFixer, BlockRule, fixer_settings, make_fixer

__all__ = ["FIXERS", "BlockFixer", "BlockRule", "fixer_settings", "make_fixer"]
