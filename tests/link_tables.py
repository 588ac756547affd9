"""Tables of links from the known model of `predictor_links`, in homes of one corridor."""

import dataclasses
import json

import numpy as np
from predictor_links import corridor_of, corridors, make_context, make_links, quick_predictor

from sionna_partial.lab.baselines import Baselines, Majority
from sionna_partial.lab.datasets.shards import INDEX_FILE, shard_path, write_shard
from sionna_partial.lab.datasets.table import COLUMNS, LinkTable


def make_table(homes=4, links=300, stages=(0, 100), seed=0):
    """Return links of homes "home 0", "home 1", ...: at each stage `links` indoors and as many anywhere.

    Receivers are outside where more than 5 m are unobserved, and in outage there; those with less than 2 m are seen,
    and transmitters within 10 m.
    """
    parts = []
    for index, (home, stage) in enumerate((home, stage) for home in range(homes) for stage in stages):
        phi, state, gain_db = make_links(2 * links, seed=seed + index)
        anywhere = np.arange(2 * links) >= links
        inside = ~anywhere | (phi.unobserved_distance_m < 5.0)
        parts.append(
            LinkTable(
                home=np.full(2 * links, f"home {home}"),
                stage=np.full(2 * links, stage),
                features=dataclasses.replace(phi, context=make_context(phi)),
                maps=corridors(),
                map_index=corridor_of(phi),
                link_state=np.where(inside, state, 0).astype(np.uint8),
                gain_db=np.where(inside, gain_db, -150.0),
                inside=inside,
                anywhere=anywhere,
                observed_fraction=np.full(2 * links, 0.5),
                complete_maps={f"home {home}": corridors()[-1]},
            )
        )
    return LinkTable.concatenate(parts)


def make_dataset(folder, table, frequency_hz=28e9, diffraction=None):
    """Write a table as a data set, as `sionna-partial dataset` does, and return its folder."""
    names = list(dict.fromkeys(map(str, table.home)))
    for name in names:
        shard_path(folder, name).parent.mkdir(parents=True, exist_ok=True)
        write_shard(table.take(table.home == name), shard_path(folder, name), {})
    trace = {"frequency_hz": frequency_hz, "diffraction": diffraction}
    index = {"homes": [{"name": name} for name in names], "settings": {"trace": trace}}
    (folder / INDEX_FILE).write_text(json.dumps(index))
    return folder


def assert_same(first, second):
    for one, other, names in (
        (first, second, COLUMNS),
        (first.features, second.features, ("link_state", "unobserved_distance_m", "distance_m", "gain_db")),
        (
            first.context,
            second.context,
            ("tx_m", "rx_m", "indirect_gain_db", "strongest_unobserved_m", "tx_seen", "rx_seen"),
        ),
    ):
        for name in names:
            left, right = getattr(one, name), getattr(other, name)
            np.testing.assert_array_equal(left, right, err_msg=name)
            assert left.dtype == right.dtype, name
    for home in set(first.home):
        assert first.complete_maps[home] == second.complete_maps[home]
    pairs = set(zip(first.map_index, second.map_index, strict=True))
    assert all(first.maps[one] == second.maps[other] for one, other in pairs)


def fitted_baselines():
    return Baselines(Majority((0.3, 0.3, 0.4), (-150.0, -65.0, -85.0), (0.0, 6.0, 10.0)), quick_predictor())
