"""Maps of other formats: drawings, building models, pictures, recordings, clouds, simulators, vacuum robots."""

from sionna_partial.resources import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)
