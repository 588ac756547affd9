"""A worked example: the walls of a home are of a material that nobody told us; a few measured links give it away.

A robot has mapped the shipped apartment, and measured the path gain of some links in it. Here the measurements are made
up: the gains that a hidden material gives, with 3 dB of noise. `calibrate_materials` sees the map and the noisy gains
alone. Run it with

    python examples/calibrate_materials.py
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.resources import scenes_folder
from sionna_partial.tracing.slab import reflection_loss_db

HIDDEN = sp.Material(relative_permittivity=5.24, conductivity_s_m=0.626, thickness_m=0.03)
"""Concrete at 28 GHz, whose slabs are nearly opaque: their conductivity hardly shows."""

START = sp.Material(thickness_m=0.03)
"""Drywall, the default. The thickness is taken to be known."""

TRACE = sp.TraceSettings(max_depth=2)
ANGLES_DEG = (0.0, 30.0, 45.0, 60.0)


def main() -> None:
    """Measure, calibrate, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("calibration.png"), help="where the picture goes")
    parser.add_argument("--links", type=int, default=120, help="measured links")
    arguments = parser.parse_args()
    home = sp.load_map(scenes_folder() / "apartment" / "complete")
    measurements = measure(home, arguments.links)
    result = sp.calibrate_materials(home, measurements, start=START, trace_settings=TRACE)
    print(f"permittivity {result.permittivity:.2f} +- {result.permittivity_std:.2f}")
    print(f"conductivity {result.conductivity:.3f} +- {result.conductivity_std:.3f} S/m")
    print(f"cannot be determined: {', '.join(result.undetermined) or 'nothing'}")
    loss_db, std_db = result.reflection_loss_db(ANGLES_DEG)
    truth_db = reflection_loss_db(
        HIDDEN.relative_permittivity, HIDDEN.conductivity_s_m, HIDDEN.thickness_m, TRACE.frequency_hz, ANGLES_DEG
    )
    for angle, loss, std, truth in zip(ANGLES_DEG, loss_db, std_db, truth_db, strict=True):
        print(f"a reflection at {angle:g} degrees loses {loss:.2f} +- {std:.2f} dB; in truth {truth:.2f} dB")
    sp.plot_calibration(result).savefig(arguments.out)
    print(f"wrote {arguments.out}; sp.predict_map(result.scene, tx) predicts with this material")


def measure(home: sp.PartialMap, links: int) -> dict[str, NDArray[np.float64]]:
    """Make up measurements: transmitters at 4 places, receivers all over the home, 3 dB of noise."""
    rng = np.random.default_rng(7)
    cells = np.argwhere(home.state == sp.CellState.FREE)
    places = cells[rng.choice(len(cells), 4 + links, replace=False)][:, ::-1] + 0.5
    places = np.column_stack([places * home.resolution_m + home.origin_m, np.full(len(places), 1.5)])
    tx, rx = places[:4], places[4:]
    traced = sp.trace_links(home, tx, rx, trace_settings=TRACE, scene_settings=sp.SceneSettings(material=HIDDEN))
    of_link = np.arange(links) % len(tx)
    gain_db = traced.gain_db[of_link, np.arange(links)] + 3.0 * rng.standard_normal(links)
    return {"tx": tx[of_link], "rx": rx, "gain_db": gain_db}


if __name__ == "__main__":
    main()
