"""
Coverage at 2.4, 5, 28 and 60 GHz
=================================

Below 24 GHz paths go through walls, from there on walls are opaque, unless set otherwise. Here one
transmitter covers the shipped apartment, whose walls are of drywall, at four bands. The map is complete, so that the
mean gain is the traced one.
"""

import matplotlib.pyplot as plt

import sionna_partial as sp
from sionna_partial.resources import scenes_folder

apartment = sp.load_map(scenes_folder() / "apartment" / "complete")
TX_M = (7.0, 9.8, 2.0)

# %%
# All that differs is the frequency; `refraction` sets it explicitly.

coverages = {
    f"{band_ghz:g} GHz": sp.predict_map(
        apartment, TX_M, trace_settings=sp.TraceSettings(frequency_hz=band_ghz * 1e9), spacing_m=0.3
    )
    for band_ghz in (2.4, 5.0, 28.0, 60.0)
}
for band, coverage in coverages.items():
    outage, median_db = float(coverage.p_outage.mean()), float(coverage.gain_mean_db.median())
    print(f"{band}, {coverage.attrs['walls']}: {outage:.0%} in outage, median {median_db:.0f} dB")
assert [coverage.attrs["walls"] for coverage in coverages.values()] == ["through walls"] * 2 + ["opaque walls"] * 2

# %%
# With walls that transmit, every receiver has a path.

figure, axes = plt.subplots(1, 4, figsize=(16, 4.6), layout="compressed", sharey=True)
for axis, (band, coverage) in zip(axes, coverages.items(), strict=True):
    image = coverage.gain_mean_db.plot(ax=axis, vmin=-150, vmax=-40, cmap="viridis", add_colorbar=False)
    axis.plot(*TX_M[:2], marker="^", color="white", markeredgecolor="black", markersize=10)
    axis.set(title=f"{band}, {coverage.attrs['walls']}", aspect="equal")
figure.colorbar(image, ax=axes, label="path gain [dB]")

# %%
# One link, and the walls that each of its paths goes through: interaction 4 is a refraction.

links = sp.trace_links(apartment, TX_M, [(3.0, 6.0, 1.5)], trace_settings=sp.TraceSettings(frequency_hz=5e9))
paths = links.to_dataframe("paths").sort_values("gain_db", ascending=False)
print(paths[["gain_db", "delay_s", "interactions", "walls"]].head(5))
assert (paths.walls > 0).any()
