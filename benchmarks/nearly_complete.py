"""Nearly complete maps: homes driven to the end by a lidar of 12 m, where small pockets alone stay unknown.

Of links whose ends are both seen and that have no line of sight on the map: the error of the trace, of the networks
alone (the baseline) and of the default predictor, which takes the trace with its measured errors there; with exact
ranges, and with noise of 3 cm and a drift of 0.2 %. Truth is the trace of the complete building. FOLDER holds complete
maps, one folder with a map.yaml for each; without it, procedural homes are taken. Run it with

    python benchmarks/nearly_complete.py --homes 8
    python benchmarks/nearly_complete.py --maps ../shared/gibson --homes 4
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import sionna_partial as sp
from sionna_partial.datasets.home_links import closed_home
from sionna_partial.evaluation.evaluate import measure
from sionna_partial.maps.partial_map import cell_centres_m
from sionna_partial.prediction.predictor import LinkPrediction

FIRST_SEED = 73_000
ERRORS = {"exact": {}, "noise": {"range_noise_m": 0.03, "drift_m_per_m": 0.002}}
TRANSMITTERS, RECEIVERS = 2, 250
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
    """Print one row of the table for each home, and for all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", type=Path, metavar="FOLDER")
    parser.add_argument("--homes", type=int, default=8)
    arguments = parser.parse_args()
    models = ("trace", "networks", "predictor")
    print(
        "| home | ranges | nearly complete | links | "
        + " | ".join(f"{name}: RMSE, mean std, rms std [dB], in 90 %" for name in models)
        + " |"
    )
    print("|---" * (4 + len(models)) + "|")
    found: dict[str, list[Links]] = {name: [] for name in ERRORS}
    for name, home in homes(arguments.maps, arguments.homes):
        for errors, sensor in ERRORS.items():
            lidar = sp.SensorSettings(field_of_view_deg=360.0, range_m=12.0, **sensor)
            partial = sp.explore(home, (0.999,), 0, sensor=lidar)[0]
            links = links_of(home, partial)
            print(row(name, errors, "yes" if partial.is_nearly_complete else "no", links), flush=True)
            found[errors] += [links] if partial.is_nearly_complete else []
    for errors, parts in found.items():
        if parts:
            print(row("**all that are nearly complete**", errors, str(len(parts)), Links.joined(parts)))


def homes(folder: Path | None, count: int) -> Iterator[tuple[str, sp.PartialMap]]:
    """Names and complete maps."""
    if folder is None:
        yield from ((f"seed {seed}", sp.make_home(seed)) for seed in range(FIRST_SEED, FIRST_SEED + count))
    else:
        for path in sorted(folder.glob("*/map.yaml"))[:count]:
            yield path.parent.name, closed_home(sp.load_map(path), path.parent.name)


def links_of(home: sp.PartialMap, partial: sp.PartialMap) -> Links:
    """Trace and predict links between cells that are free in both maps, without line of sight on the partial one."""
    rng, parts, predictor = np.random.default_rng(0), [], sp.Predictor.load()
    height_m = np.full(RECEIVERS, HEIGHT_M)
    both = np.argwhere((home.state == sp.CellState.FREE) & (free_on(partial, home)))
    for _ in range(TRANSMITTERS):
        points_m = cell_centres_m(home, both[rng.choice(len(both), RECEIVERS)])
        tx_m, *rx_m = np.column_stack([points_m, height_m])
        rx_m = np.array(rx_m)[np.linalg.norm(rx_m - tx_m, axis=1) > 0.2]
        truth, traced = (sp.trace_links(each, tx_m, rx_m) for each in (home, partial))
        phi = sp.link_features(partial, traced)
        alone = replace(phi, context=replace(phi.context, nearly_complete=np.zeros(len(phi), dtype=bool)))
        models = {
            "trace": LinkPrediction.of_trace(phi),
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


def row(name: str, errors: str, complete: str, links: Links) -> str:
    """Return one row of the table."""
    columns = [name, errors, complete, str(len(links.gain_db))]
    for prediction in links.models.values():
        found, std_db = measure(prediction, links.link_state, links.gain_db), prediction.gain_std_db
        columns.append(
            f"{found.rmse_db:.2f}, {std_db.mean():.2f}, {np.sqrt(np.mean(std_db**2)):.2f}, {found.coverage_90:.3f}"
        )
    return "| " + " | ".join(columns) + " |"


if __name__ == "__main__":
    main()
