"""Fixers: what repairs a rendered frame, and what tells it where the road is."""

from alpasim_plugin.fixers import identity as identity
from alpasim_plugin.fixers import onefixer as onefixer
from alpasim_plugin.fixers.base import FIXERS, BlockFixer, BlockRule, fixer_settings, make_fixer

__all__ = ["FIXERS", "BlockFixer", "BlockRule", "fixer_settings", "make_fixer"]
