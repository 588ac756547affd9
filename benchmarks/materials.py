"""Loss of walls at normal incidence, of the materials that `Material.named` has, as in docs/walls.md."""

import numpy as np

from sionna_partial.errors import SettingsError
from sionna_partial.scene.scene import constants_of
from sionna_partial.settings import WALL_MATERIALS
from sionna_partial.tracing.power import transmission_coefficients

BANDS_GHZ = 2.4, 5.0, 28.0, 60.0


def main() -> None:
    """Print the table."""
    print(f"| material | thickness [cm] | {' | '.join(f'{band:g} GHz' for band in BANDS_GHZ)} |")
    print("|---|---|---|---|---|---|")
    for name, material in WALL_MATERIALS.items():
        losses = []
        for band in BANDS_GHZ:
            try:
                material.require_frequency(band * 1e9)
            except SettingsError:
                losses.append("no model")
                continue
            constants = *constants_of(material, band * 1e9), material.thickness_m
            te, _ = transmission_coefficients(*constants, band * 1e9, 1.0)  # type: ignore[call-arg]
            loss_db = -20.0 * np.log10(max(float(np.abs(te)), 1e-10))
            losses.append(f"{loss_db:.1f}" if loss_db < 150.0 else "> 150")
        print(f"| {name} | {100.0 * material.thickness_m:g} | {' | '.join(losses)} |")


if __name__ == "__main__":
    main()
