"""
A robot explores a home
=======================

`explore_trajectory` sends a robot through a home: one action per step, a camera of 90 degrees and 3.2 m. The home is
one that ships; `make_home` makes others.
"""

import numpy as np
from matplotlib.figure import Figure

import sionna_partial as sp
from sionna_partial.resources import scenes_folder

home = sp.load_map(scenes_folder() / "apartment" / "complete")
trajectory = sp.explore_trajectory(home, steps=(0, 25, 50, 100, 150, 200), seed=3)
maps = sp.plots.plot_exploration(trajectory.at((50, 100, 200)))

# %%
# The link from a transmitter to a room at the other end of the home is predicted at each stage, from the robot's map.

tx, rx = (7.0, 9.8, 1.5), [(10.0, 3.5, 1.5)]
predictor = sp.Predictor.load()
rows = []
for step, partial in zip(trajectory.steps, trajectory.maps, strict=True):
    links = sp.trace_links(partial, tx, rx)
    link = predictor.predict(sp.link_features(partial, links))
    rows.append((step, link.p_outage[0], link.gain_mean_db[0], link.gain_std_db[0]))
    print("step {:3d}: P(outage) {:.2f}, gain {:6.1f} +- {:4.1f} dB".format(*rows[-1]))

# %%
# The last map is nearly complete on the way between the two ends, and the prediction is nearly certain.

steps, _, mean_db, std_db = np.array(rows).T
truth_db = sp.trace_links(home, tx, rx).gain_db[0]
assert std_db[-1] < std_db[0] / 2
assert abs(mean_db[-1] - truth_db) < 2 * std_db[-1]
figure = Figure(figsize=(6, 3), layout="constrained")
axis = figure.subplots()
axis.errorbar(steps, mean_db, std_db, marker="o", capsize=3, label="prediction: mean and standard deviation")
axis.axhline(truth_db, color="black", linestyle="--", label="trace of the complete home")
axis.set(xlabel="exploration steps", ylabel="path gain [dB]")
axis.legend()
