"""
What are the walls made of?
===========================

The walls of a home are of an unknown material; measured path gains of some links determine how they reflect.
Here the measurements are made up: the gains that a hidden material gives, with 3 dB of noise. `calibrate_materials`
gets the map and the noisy gains alone.
"""

import numpy as np

import sionna_partial as sp
from sionna_partial.resources import scenes_folder
from sionna_partial.tracing.power import reflection_loss_db

THICKNESS_M = 0.03  # taken to be known
HIDDEN = sp.Material(relative_permittivity=5.24, conductivity_s_m=0.626, thickness_m=THICKNESS_M)  # concrete
LINKS = 120
FREQUENCY_HZ = 28e9

# %%
# Measurements: transmitters at four positions, receivers all over the home.

home = sp.load_map(scenes_folder() / "apartment" / "complete")
rng = np.random.default_rng(7)
cells = rng.choice(np.argwhere(home.state == sp.CellState.FREE), 4 + LINKS, replace=False)[:, ::-1] + 0.5
points = np.column_stack([cells * home.resolution_m + home.origin_m, np.full(len(cells), 1.5)])
tx, rx = points[:4], points[4:]
traced = sp.trace_links(home, tx, rx, scene_settings=sp.SceneSettings(material=HIDDEN))
of_link = np.arange(LINKS) % len(tx)
gain_db = traced.gain_db[of_link, np.arange(LINKS)] + 3.0 * rng.standard_normal(LINKS)

# %%
# Calibration starts from drywall, the default material.

measurements = {"tx": tx[of_link], "rx": rx, "gain_db": gain_db}
result = sp.calibrate_materials(home, measurements, start=sp.Material(thickness_m=THICKNESS_M))
print(f"permittivity {result.permittivity:.2f} +- {result.permittivity_std:.2f}")
print(f"conductivity {result.conductivity_s_m:.3f} +- {result.conductivity_std_s_m:.3f} S/m")
print(f"cannot be determined: {', '.join(result.undetermined) or 'nothing'}")

# %%
# A slab of concrete is nearly opaque, so its conductivity hardly shows. What a prediction needs is the loss of a
# reflection, and that is determined well.

ANGLES_DEG = (0.0, 30.0, 45.0, 60.0)
loss_db, std_db = result.reflection_loss_db(ANGLES_DEG)
truth_db = reflection_loss_db(
    HIDDEN.relative_permittivity, HIDDEN.conductivity_s_m, HIDDEN.thickness_m, FREQUENCY_HZ, ANGLES_DEG
)
for angle, loss, std, truth in zip(ANGLES_DEG, loss_db, std_db, truth_db, strict=True):
    print(f"a reflection at {angle:g} degrees loses {loss:.2f} +- {std:.2f} dB; in truth {truth:.2f} dB")
assert np.all(np.abs(loss_db - truth_db) <= np.maximum(0.6, 2.5 * std_db))
figure = sp.plots.plot_calibration(result)
