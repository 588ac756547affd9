"""
Several transmitters
====================

`predict_map` takes one transmitter. Several are one call each, and the maps are combined with xarray: which of two
positions serves a receiver better, and how strong is the better one?
"""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import sionna_partial as sp
from sionna_partial.resources import scenes_folder

partial = sp.load_map(scenes_folder() / "house" / "step150" / "map.yaml")
positions = [(4.5, 11.0, 1.5), (7.0, 3.5, 1.5)]
predictor = sp.Predictor.load()
maps = [sp.predict_map(partial, tx, predictor=predictor, spacing_m=0.3) for tx in positions]
coverage = xr.concat(maps, dim="transmitter", combine_attrs="drop_conflicts")

# %%
# The mean gain of each transmitter, and of the stronger of the two at every receiver.

gain_db = coverage["gain_mean_db"]
for tx, of_one in zip(positions, gain_db, strict=True):
    print(f"{tx}: median of the mean gain {of_one.median().item():.1f} dB")
print(f"the stronger one: {gain_db.max('transmitter').median().item():.1f} dB")

# %%
# Where each of them is the stronger one, and the gain of that one. Black: no receiver can be there.

figure = Figure(figsize=(10, 3.6), layout="constrained")
axes = figure.subplots(1, 2, sharey=True)
known = gain_db.notnull().all("transmitter")
best = gain_db.fillna(-np.inf).argmax("transmitter").where(known)
bar = {"ticks": [0, 1], "label": "stronger transmitter"}
best.plot.imshow(ax=axes[0], levels=[-0.5, 0.5, 1.5], cmap="coolwarm", cbar_kwargs=bar)
gain_db.max("transmitter").plot.imshow(ax=axes[1], cmap="viridis", cbar_kwargs={"label": "mean gain [dB]"})
for axis in axes:
    axis.plot(*np.array(positions)[:, :2].T, "*", color="white", markeredgecolor="black", markersize=12)
    axis.set(aspect="equal", facecolor="black", xlabel="x [m]", ylabel="y [m]")
