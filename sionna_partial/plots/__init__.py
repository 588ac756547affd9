"""Figures of results that other packages compute."""

from sionna_partial.resources import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)
