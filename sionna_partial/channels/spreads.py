"""Large-scale parameters of links from the power, delay and angles of their paths."""

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

if TYPE_CHECKING:
    from sionna_partial.tracing.links import TracedLinks


def spreads(links: "TracedLinks") -> xr.Dataset:
    """Large-scale parameters (`TracedLinks.spreads`)."""
    link, power = links.path_link, np.abs(links.a) ** 2

    def total(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(link, values, links.gain_db.size).astype(np.float64)

    with np.errstate(divide="ignore", invalid="ignore"):
        all_power = total(power)
        mean_s = total(power * links.delay_s) / all_power
        delay_s = np.sqrt(total(power * (links.delay_s - mean_s[link]) ** 2) / all_power)
        direct = total(power * (links.interactions == 0).all(axis=1))
        k_factor_db = np.where(direct > 0.0, 10.0 * np.log10(direct / (all_power - direct).clip(0.0)), np.nan)

        def angular_rad(angle: NDArray[np.float64]) -> NDArray[np.float64]:
            length = np.hypot(total(power * np.cos(angle)), total(power * np.sin(angle))) / all_power
            return np.sqrt(-2.0 * np.log(length.clip(max=1.0)))

        angles = {
            f"{name}_{end}_spread_rad": angular_rad(values[:, column])
            for end, values in (("departure", links.departure_rad), ("arrival", links.arrival_rad))
            for column, name in enumerate(("zenith", "azimuth"))
        }
    values: dict[str, NDArray[Any]] = {
        "path_loss_db": np.where(all_power > 0.0, -links.gain_db.ravel(), np.nan),
        "k_factor_db": k_factor_db,
        "delay_spread_s": delay_s,
        **angles,
    }
    units = {name: name.rpartition("_")[2].replace("db", "dB") for name in values}
    table = {
        name: (("tx", "rx")[2 - links.gain_db.ndim :], each.reshape(links.gain_db.shape), {"units": units[name]})
        for name, each in values.items()
    }
    return xr.Dataset(table, attrs={"source": "3GPP TR 38.901, sections 7.5 and A.1"})
