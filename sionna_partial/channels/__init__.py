"""Channels of links: responses of antenna arrays, beams, spreads, files."""

from sionna_partial.resources import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)
