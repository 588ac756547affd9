"""Data sets of links, training of networks, their evaluation, and reports of it."""

from sionna_partial.resources import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)
