"""
Where to place a transmitter
============================

A robot has seen a part of a home. `place_transmitter` searches the position that covers the home best, as predicted
from that part alone.
"""

import numpy as np
from numpy.typing import ArrayLike

import sionna_partial as sp
from sionna_partial.resources import scenes_folder

THRESHOLD_DB = -100.0

partial = sp.load_map(scenes_folder() / "apartment" / "step100")
found = sp.place_transmitter(partial, objective="coverage", threshold_db=THRESHOLD_DB, seed=0)
x, y, z = found.position_m
print(f"position ({x:.2f}, {y:.2f}, {z:.2f}) m: predicted coverage {found.score:.1%}")
figure = sp.plots.plot_placement(found)

# %%
# The rest of this home is known, too, so that the position can be compared with the truth: the fraction of the home
# where the full trace finds a gain above the threshold. For comparison, the free cell nearest to the middle of the
# robot's map.

home = sp.load_map(scenes_folder() / "apartment" / "complete")


def centres_m(cells: ArrayLike, building: sp.PartialMap) -> np.ndarray:
    """Positions of cells (row, column), 1.5 m above the floor."""
    plan = (np.asarray(cells)[:, ::-1] + 0.5) * building.resolution_m + building.origin_m
    return np.column_stack([plan, np.full(len(plan), 1.5)])


def coverage(tx: ArrayLike) -> float:
    """Fraction of the home where the full trace finds a gain above the threshold."""
    rx = centres_m(np.argwhere(home.state == sp.CellState.FREE)[::97], home)
    rx = rx[np.linalg.norm(rx - tx, axis=1) > 0.02]
    return float(np.mean(sp.trace_links(home, tx, rx).gain_db > THRESHOLD_DB))


free = centres_m(np.argwhere(partial.state == sp.CellState.FREE), partial)
middle = free[np.linalg.norm(free - free.mean(axis=0), axis=1).argmin()]
covered, covered_from_middle = coverage(found.position_m), coverage(middle)
print(f"in truth it covers {covered:.1%}")
print(f"the middle of what was seen covers {covered_from_middle:.1%}")
assert covered > covered_from_middle
