"""Maps of other formats: drawings, building models, pictures, recordings, clouds, simulators, vacuum robots."""
