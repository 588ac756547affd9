"""Floor plans and meshes: read, written, made and explored.

- `partial_map` is what everybody else takes; `map_files` is the door for files; `ros_map` and `map_turn` are behind it.
- `mesh` is what a map of a scan carries; `mesh_files` and `mesh_scene` read it, `mesh_map` lays it on cells, `mesh_cut`
  cuts it at the border of what has been observed.
- `homes` makes homes, `explore` lets a robot see them: `robot` walks, `camera` sees and maps.
"""
