"""Fixers: what repairs a rendered frame."""

from alpasim_plugin.fixers.base import fixer_settings, make_fixer

__all__ = ["fixer_settings", "make_fixer"]
