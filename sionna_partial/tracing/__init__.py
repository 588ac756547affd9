"""Map -> scene -> paths, in this order.

- `scene` writes scenes.
- What paths a floor plan may have: `plan`, `beams`, `candidates` (floor and ceiling added), `diffraction`.
- What paths a mesh may have: `rays`, `mesh_planes`, `ray_chains`, `mesh_candidates`.
- Sionna RT: `sionna_rt` loads it, `contract` names the internal parts that `chain` and `solver` lean on, `stock`
  does without them, and `paths` is what either of them gives.
- `generator` knows which scene has which candidates, `probe` whether `solver` can be trusted, and `trace` is the door
  for everybody else. `path_set` is the forward model: power and vertices of paths found once; `gradients` asks it.
"""
