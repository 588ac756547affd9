"""The only package that imports Dr.Jit and Mitsuba.

- `finder` writes the scene of a map and finds its paths: candidates of floor plans (`plan`) or meshes (`mesh`), which
  `engine` verifies.
- `simulation` is the entry for links; `path_set` evaluates and differentiates paths for other parameters.
"""
