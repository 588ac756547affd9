"""
Coverage of a half-explored home
================================

A robot has seen less than half of an apartment. `predict_map` returns the distribution of the link to every receiver
position, on the observed part and beyond it.
"""

import sionna_partial as sp
from sionna_partial.resources import scenes_folder

partial = sp.load_map(scenes_folder() / "apartment" / "step100" / "map.yaml")
print(f"observed: {partial.observed_fraction:.0%} of the home")

# %%
# The result is an :class:`xarray.Dataset` on (y, x), in metres. Black is wall; the hatched area was not observed.

coverage = sp.predict_map(partial, tx=(7.0, 9.8, 1.5), spacing_m=0.3)
figure = sp.plots.plot_coverage(coverage)

# %%
# One receiver, 5 m away in a room that was not observed: probabilities of the link states, and mean and standard
# deviation of the gain with an outage at -150 dB.

receiver = coverage.sel(x=2.0, y=7.9, method="nearest")
for name in ("p_los", "p_nlos", "p_outage", "gain_mean_db", "gain_std_db"):
    print(f"{name:13s} {receiver[name].item():8.2f}")

# %%
# The home is made up, so the truth is known: the trace of the complete plan, which `predict_map` returns for complete
# maps.

complete = sp.load_map(scenes_folder() / "apartment" / "complete" / "map.yaml")
truth = sp.predict_map(complete, tx=(7.0, 9.8, 1.5), spacing_m=0.3)
inside = truth["valid"] & coverage["valid"] & (truth["p_indoor"] > 0.5)
correct = (coverage["link_state"] == truth["link_state"]).where(inside)
observed, others = (correct.where(each).mean().item() for each in (coverage["observed"], ~coverage["observed"]))
print(f"link state correct: {observed:.0%} of the observed receivers, {others:.0%} of the others")
assert observed > 0.9 > others > 0.5
