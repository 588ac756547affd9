"""
A scene in stock Sionna RT, and back
====================================

A partial map is exported, its coverage is rendered by Sionna RT, an object is added to the scene in memory, and the
changed scene is predicted.
"""

from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import trimesh

import sionna_partial as sp  # before sionna.rt, mitsuba and drjit
from sionna_partial.resources import scenes_folder

import sionna.rt as rt  # isort: skip

# %%
# Our scene in Sionna RT
# ----------------------
# `merge_shapes=False` keeps walls, floor and ceiling apart, so that the ceiling can be removed from the picture.
# `docs/notebooks/coverage_in_sionna_rt.ipynb` compares such a coverage with `RadioMapSolver`.

folder = Path(mkdtemp())
partial = sp.load_map(scenes_folder() / "apartment" / "step100" / "map.yaml")
coverage = sp.predict_map(partial, tx=(7.0, 9.8, 1.5), spacing_m=0.3)
sp.export_scene(partial, folder / "scene")
scene = rt.load_scene(str(folder / "scene" / "scene.xml"), merge_shapes=False)
x0, y0, x1, y1 = partial.bounds_m
scene.edit(remove="ceiling")
camera = rt.Camera(position=[(x0 + x1) / 2, y0 - 5.0, 15.0], look_at=[(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
floor = coverage.radio.radio_map(scene)
figure = scene.render(camera=camera, radio_map=floor, rm_vmin=-130, rm_vmax=-50, resolution=[640, 480], num_samples=64)

# %%
# A changed scene, predicted
# --------------------------
# Changes in memory are written to a scene file, with one PLY file for each object. `observed` gives the known cells.

changed = folder / "changed"
changed.mkdir()
trimesh.creation.box((0.6, 0.4, 1.8)).export(folder / "cabinet.ply")
steel = rt.ITURadioMaterial("steel", "metal", thickness=0.01)
cabinet = rt.SceneObject(fname=str(folder / "cabinet.ply"), name="cabinet", radio_material=steel)
scene.edit(add=cabinet)
cabinet.position = [7.5, 9.3, 0.9]

shapes, materials = "", {}
for name, thing in scene.objects.items():
    thing.mi_mesh.write_ply(str(changed / f"{name}.ply"))
    material = thing.radio_material
    materials[material.name] = "".join(
        f'<float name="{key}" value="{np.ravel(getattr(material, key))[0]}"/>'
        for key in ("relative_permittivity", "conductivity", "thickness")
    )
    filename = f'<string name="filename" value="{name}.ply"/>'
    shapes += f'<shape type="ply" id="{name}">{filename}<ref name="bsdf" id="{material.name}"/></shape>\n'
bsdfs = "".join(f'<bsdf type="radio-material" id="{name}">{values}</bsdf>\n' for name, values in materials.items())
(changed / "scene.xml").write_text(f'<scene version="2.1.0">\n{bsdfs}{shapes}</scene>')

with_cabinet = sp.load_map(changed / "scene.xml", observed=partial)
coverage = sp.predict_map(with_cabinet, tx=(7.0, 9.8, 1.5), spacing_m=0.3)
sp.plots.plot_coverage(coverage)
