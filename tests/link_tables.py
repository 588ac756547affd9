"""Tables of links from the known model of `predictor_links`, in homes without plans."""

import json

import numpy as np
from predictor_links import make_links, quick_predictor

from sionna_partial.training.baselines import Baselines, Majority
from sionna_partial.training.link_table import LinkTable
from sionna_partial.training.shards import INDEX_FILE, shard_path, write_shard


def make_table(homes=4, links=300, stages=(0, 100), seed=0):
    """Return links of homes "home 0", "home 1", ...: at each stage `links` indoors and as many anywhere.

    Receivers are outside where more than 5 m are unobserved, and in outage there; those with less than 2 m are seen.
    """
    parts = []
    for index, (home, stage) in enumerate((home, stage) for home in range(homes) for stage in stages):
        phi, state, gain_db = make_links(2 * links, seed=seed + index)
        anywhere = np.arange(2 * links) >= links
        inside = ~anywhere | (phi.unobserved_distance_m < 5.0)
        rx_m = np.column_stack([phi.distance_m, np.zeros(2 * links), np.full(2 * links, 1.5)])
        parts.append(
            LinkTable(
                home=np.full(2 * links, f"home {home}"),
                stage=np.full(2 * links, stage),
                tx_m=np.tile([0.0, 0.0, 1.5], (2 * links, 1)),
                rx_m=rx_m,
                phi=phi,
                link_state=np.where(inside, state, 0).astype(np.uint8),
                gain_db=np.where(inside, gain_db, -150.0),
                inside=inside,
                anywhere=anywhere,
                tx_seen=phi.distance_m < 10.0,
                rx_seen=phi.unobserved_distance_m < 2.0,
                observed_fraction=np.full(2 * links, 0.5),
            )
        )
    return LinkTable.concatenate(parts)


def make_dataset(folder, table, frequency_hz=28e9, diffraction=None):
    """Write a table as a data set, as `sionna-partial dataset` does, and return its folder."""
    names = list(dict.fromkeys(map(str, table.home)))
    for name in names:
        shard_path(folder, name).parent.mkdir(exist_ok=True)
        write_shard(table.take(table.home == name), shard_path(folder, name), {})
    trace = {"frequency_hz": frequency_hz, "diffraction": diffraction}
    index = {"homes": [{"name": name} for name in names], "settings": {"trace": trace}}
    (folder / INDEX_FILE).write_text(json.dumps(index))
    return folder


def fitted_baselines():
    """Return baselines that say something, without training."""
    return Baselines(Majority((0.3, 0.3, 0.4), (-150.0, -65.0, -85.0), (0.0, 6.0, 10.0)), quick_predictor())
