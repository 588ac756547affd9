"""
Three access points in a half-seen office
=========================================

A robot has seen a part of an office floor. Where will three access points serve, with which SINR, and how sure is that?
"""

import sionna_partial as sp

floor = sp.make_home(220001, kind="floor")
partial = sp.explore(floor, (0.5,), sensor=sp.SensorSettings(field_of_view_deg=360.0, range_m=12.0))[0]
placed = sp.place_transmitters(partial, count=3, threshold_db=-90.0, tx_height_m=2.2)
print(f"observed {partial.observed_fraction:.0%}, predicted coverage with three access points {placed.score:.0%}")
placement_figure = sp.plots.plot_network_placement(placed)

# %%
# All three in one call; links are drawn together, as one unseen wall may block more than one access point.

access_points = {f"AP {number + 1}": position for number, position in enumerate(placed.positions_m)}
coverage = sp.predict_map(partial, access_points, spacing_m=1.0)
network = sp.predict_network(coverage, tx_power_dbm=20.0, bandwidth_hz=400e6, load=0.5, sinr_threshold_db=10.0)
for name, share in network.p_best.mean(("x", "y")).to_series().items():
    print(f"{name}: strongest at {share:.0%} of the receivers")
alone = coverage.p_outage.prod("tx", skipna=False).mean().item()
together = network.p_all_outage.mean().item()
print(f"all fail: {together:.1%}; if they were independent, {alone:.1%}")
assert 0.0 < alone < together

# %%
# Best server, SINR, the probability of 10 dB, and the rate.

figure = sp.plots.plot_network(network)

# %%
# The coverage of each transmitter. ``sp.save_coverage(coverage, "coverage.html")`` writes a page where it is chosen.

coverage_figure = sp.plots.plot_coverage(coverage, layers=("gain_mean_db", "p_outage"))
