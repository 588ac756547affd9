"""
Paths of a link
===============

`trace_links` returns the paths from a transmitter to the receivers: complex gain, delay, angles, and the points where
each was reflected or diffracted. Paths that change the power of a link by less than 0.1 dB are left out.
"""

import numpy as np
from matplotlib.figure import Figure

import sionna_partial as sp
from sionna_partial.resources import scenes_folder

home = sp.load_map(scenes_folder() / "apartment" / "complete" / "map.yaml")
tx, rx = (7.0, 9.8, 1.5), [(8.0, 10.0, 1.5), (8.0, 7.0, 1.5)]
links = sp.trace_links(home, tx, rx)
for i, (state, gain_db) in enumerate(zip(links.link_state, links.gain_db, strict=True)):
    print(f"link {i}: {sp.LinkState(state).name}, {gain_db:.1f} dB, {np.sum(links.path_rx == i)} paths")
assert links.link_state.tolist() == [sp.LinkState.LOS, sp.LinkState.NLOS]

# %%
# The power of each path against its delay. Sionna RT's codes give the interactions of the path: 1 is a reflection, 8 a
# diffraction.

DIFFRACTION = 8

figure = Figure(figsize=(8, 3.2), layout="constrained")
for i, axis in enumerate(figure.subplots(1, 2, sharey=True)):
    for diffracted, color in ((False, "tab:blue"), (True, "tab:orange")):
        paths = (links.path_rx == i) & ((links.interactions == DIFFRACTION).any(axis=1) == diffracted)
        delay_ns, power_db = 1e9 * links.delay_s[paths], 20 * np.log10(np.abs(links.a[paths]))
        axis.vlines(delay_ns, -200, power_db, color=color, label="with a diffraction" if diffracted else "without")
    axis.set(xlabel="delay [ns]", title=f"receiver {i}: {sp.LinkState(links.link_state[i]).name}", ylim=(-170, -50))
figure.axes[0].set_ylabel("path gain [dB]")
figure.axes[1].legend()

# %%
# The same paths in the plan, the stronger the darker.

plan = Figure(figsize=(5, 5), layout="constrained")
axis = plan.subplots()
left, bottom, right, top = home.bounds_m
axis.imshow(home.state == sp.CellState.WALL, origin="lower", extent=(left, right, bottom, top), cmap="Greys")
for path in np.flatnonzero(np.abs(links.a) > 1e-6):
    points = links.vertices_m[path][np.isfinite(links.vertices_m[path, :, 0])]
    line = np.vstack([links.tx, points, links.rx[links.path_rx[path]]])
    strength = np.clip((20 * np.log10(np.abs(links.a[path])) + 120) / 60, 0.1, 1.0)
    axis.plot(line[:, 0], line[:, 1], color="tab:red", alpha=float(strength), linewidth=1.0)
axis.set(xlabel="x [m]", ylabel="y [m]")
