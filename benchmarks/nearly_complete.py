"""Nearly complete maps: buildings driven to the end by a lidar, where small pockets alone stay unknown.

Of links whose ends are both seen and that have no line of sight on the map: the errors of the trace between the mapped
walls, of the networks alone and of the default predictor. Homes have a lidar of 12 m, and a drift of 0.2 % where the
range noise is 2 cm. Halls and warehouses of at most `MOST_CELLS` have one of 20 m and, as SLAM closes loops, a drift of
0.02 %. Truth is the trace of the complete building. FOLDER holds complete maps, one folder with a map.yaml for each, in
place of procedural homes. Run it with

    python benchmarks/nearly_complete.py --homes 8 --halls 8 --warehouses 8
    python benchmarks/nearly_complete.py --maps ../shared/gibson --homes 4 --halls 0 --warehouses 0
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import sionna_partial as sp
from sionna_partial.datasets.home_links import closed_home
from sionna_partial.evaluation import measure
from sionna_partial.maps.partial_map import cell_centres_m
from sionna_partial.prediction.predictor import LinkPrediction

FIRST_SEED = {"home": 73_000, "hall": 73_100, "warehouse": 73_200}
RANGE_NOISES_CM = (0, 1, 2, 3)
MOST_CELLS = 250_000
TRANSMITTERS, RECEIVERS = 2, 160
HEIGHT_M = 1.5


class Links(NamedTuple):
    """Truth and predictions of links."""

    link_state: np.ndarray
    gain_db: np.ndarray
    models: dict[str, LinkPrediction]

    @classmethod
    def joined(cls, parts: list["Links"]) -> "Links":
        """Return the links of all parts."""
        models = {name: LinkPrediction.concatenate([part.models[name] for part in parts]) for name in parts[0].models}
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls._fields[:2]), models)


def main() -> None:
    """Print one row of the table for each building, and for all of a kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", type=Path, metavar="FOLDER")
    parser.add_argument("--homes", type=int, default=8)
    parser.add_argument("--halls", type=int, default=4)
    parser.add_argument("--warehouses", type=int, default=4)
    arguments = parser.parse_args()
    models = ("mapped walls", "networks", "predictor")
    print(
        "| building | noise [cm] | nearly complete | links | "
        + " | ".join(f"{name}: RMSE, mean std, rms std [dB], in 90 %" for name in models)
        + " |"
    )
    print("|---" * (4 + len(models)) + "|")
    counts = {"home": arguments.homes, "hall": arguments.halls, "warehouse": arguments.warehouses}
    for kind, count in counts.items():
        found: dict[int, list[Links]] = {noise_cm: [] for noise_cm in RANGE_NOISES_CM}
        range_m, drifts = (12.0, {2: 0.002}) if kind == "home" else (20.0, dict.fromkeys(RANGE_NOISES_CM[1:], 0.0002))
        for name, building in buildings(kind, count, arguments.maps):
            for noise_cm in RANGE_NOISES_CM:
                errors = {"range_noise_m": noise_cm / 100.0, "drift_m_per_m": drifts.get(noise_cm, 0.0)}
                lidar = sp.SensorSettings(field_of_view_deg=360.0, range_m=range_m, **errors)
                partial = sp.explore(building, (0.999,), 0, sensor=lidar)[0]
                links = links_of(building, partial)
                print(row(name, noise_cm, "yes" if partial.is_nearly_complete else "no", links), flush=True)
                found[noise_cm] += [links] if partial.is_nearly_complete else []
        for noise_cm, parts in found.items():
            if parts:
                print(row(f"**{kind}: all nearly complete**", noise_cm, str(len(parts)), Links.joined(parts)))


def buildings(kind: str, count: int, folder: Path | None) -> Iterator[tuple[str, sp.PartialMap]]:
    """Names and complete maps."""
    if folder is not None and kind == "home":
        for path in sorted(folder.glob("*/map.yaml"))[:count]:
            yield path.parent.name, closed_home(sp.load_map(path), path.parent.name)
        return
    for seed in range(FIRST_SEED[kind], FIRST_SEED[kind] + count):
        building = sp.make_home(seed, None if kind == "home" else kind)
        if building.state.size <= MOST_CELLS:
            yield f"{kind} {seed}", building


def links_of(home: sp.PartialMap, partial: sp.PartialMap) -> Links:
    """Trace and predict links between cells that are free in both maps, without line of sight on the partial one."""
    rng, parts, predictor = np.random.default_rng(0), [], sp.Predictor.load()
    height_m = np.full(RECEIVERS, HEIGHT_M)
    both = np.argwhere((home.state == sp.CellState.FREE) & (free_on(partial, home)))
    for _ in range(TRANSMITTERS):
        points_m = cell_centres_m(home, both[rng.choice(len(both), RECEIVERS)])
        tx_m, *rx_m = np.column_stack([points_m, height_m])
        rx_m = np.array(rx_m)[np.linalg.norm(rx_m - tx_m, axis=1) > 0.2]
        truth, traced = (sp.trace_links(scene, tx_m, rx_m) for scene in (home, partial))
        phi = sp.link_features(partial, traced)
        alone = replace(phi, context=replace(phi.context, both_seen=np.zeros(len(phi), dtype=bool)))
        models = {
            "mapped walls": LinkPrediction.of_trace(phi),
            "networks": predictor.predict(alone),
            "predictor": predictor.predict(phi),
        }
        taken = traced.link_state != sp.LinkState.LOS
        models = {name: prediction.take(taken) for name, prediction in models.items()}
        parts.append(Links(truth.link_state[taken], truth.gain_db[taken], models))
    return Links.joined(parts)


def free_on(partial: sp.PartialMap, home: sp.PartialMap) -> np.ndarray:
    """Cells (ny, nx) of a home that are free on the partial map."""
    cells = np.argwhere(np.ones(home.shape, dtype=bool))
    return np.reshape(partial.state_at(cell_centres_m(home, cells)) == sp.CellState.FREE, home.shape)


def row(name: str, noise_cm: int, complete: str, links: Links) -> str:
    """Return one row of the table."""
    columns = [name, str(noise_cm), complete, str(len(links.gain_db))]
    for prediction in links.models.values():
        found, std_db = measure(prediction, links.link_state, links.gain_db), prediction.gain_std_db
        columns.append(
            f"{found.rmse_db:.2f}, {std_db.mean():.2f}, {np.sqrt(np.mean(std_db**2)):.2f}, {found.coverage_90:.3f}"
        )
    return "| " + " | ".join(columns) + " |"


if __name__ == "__main__":
    main()
