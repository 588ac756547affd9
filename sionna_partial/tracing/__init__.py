"""The one door to Sionna RT: Dr.Jit and Mitsuba are imported here and nowhere else.

- `finder` writes the scene of a map and finds its paths: exact candidates of floor plans (`plan`), or those that rays
  find in meshes (`mesh`), which `engine` verifies on Sionna RT's internals.
- `trace` is the door for links, and shoots rays for what only rays find; `path_set` is the forward model: power and
  vertices of paths found once, for other parameters, and their derivatives.
"""
