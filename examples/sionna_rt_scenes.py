"""
A scene in stock Sionna RT, and back
====================================

A partial map is exported, a radio map is computed and rendered by Sionna RT, an object is added to the scene in memory,
and the changed scene is predicted.
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
# No transmitter may be in the plane of a radio map: rays that stay in the plane never cross it. The ceiling is removed
# from the picture, as `clip_at` cuts near the origin only.

folder = Path(mkdtemp())
partial = sp.load_map(scenes_folder() / "apartment" / "step100" / "map.yaml")
sp.export_scene(partial, folder / "scene")
scene = rt.load_scene(str(folder / "scene" / "scene.xml"))
scene.frequency = 28e9
scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.add(rt.Transmitter("tx", position=[7.0, 9.8, 2.5]))
x0, y0, x1, y1 = partial.bounds_m
radio_map = rt.RadioMapSolver()(
    scene,
    center=[(x0 + x1) / 2, (y0 + y1) / 2, 1.5],
    orientation=[0, 0, 0],
    size=[x1 - x0, y1 - y0],
    cell_size=[0.25, 0.25],
    max_depth=3,
    samples_per_tx=100_000,
)
print("strongest cell:", radio_map.path_gain.numpy().max())
scene.edit(remove="ceiling")
camera = rt.Camera(position=[(x0 + x1) / 2, y0 - 5.0, 15.0], look_at=[(x0 + x1) / 2, (y0 + y1) / 2, 0.0])
picture = str(folder / "radio_map.png")
scene.render_to_file(camera=camera, filename=picture, radio_map=radio_map, resolution=[320, 240], num_samples=16)

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
sp.plot_coverage(coverage)
