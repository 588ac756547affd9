"""The accessor ``coverage.radio``: methods of the coverage maps of `predict_map`."""

import json
from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import number_of, require_number, shown
from sionna_partial.constants import GAIN_FLOOR_DB, CellState
from sionna_partial.coverage.dataset import ROOM, probability_above, transmitter_text, transmitters_of
from sionna_partial.coverage.link_budget import LinkBudget, schemes, transmit_powers_dbm
from sionna_partial.display import later, picture_html
from sionna_partial.errors import PositionError
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.stock import MapPlane, planar_radio_map, stock_gain_db

FLOORS = ("observed", "all")
"""Floors of `radio.area` besides the rooms of the map."""

_PLOT = "plots.coverage_plot:plot_coverage"


@xr.register_dataset_accessor("radio")
class CoverageAccessor:
    """Methods of a coverage map from `predict_map` or `load_coverage`: ``coverage.radio``.

    Every method raises a SettingsError for a Dataset that is no coverage map.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1], [1, 0, 0, 1], [1, 0, 0, 1], [1, 1, 1, 1]]
    >>> coverage = sp.predict_map(sp.map_from_array(cells, resolution_m=1.0), (1.5, 1.5, 1.5), spacing_m=0.5)
    >>> float(coverage.radio.at(2.4, 2.4).p_los)
    1.0
    >>> float(coverage.radio.probability_above(-60.0).sel(x=2.25, y=2.25))
    0.0
    """

    def __init__(self, coverage: xr.Dataset) -> None:
        self._given = coverage

    @property
    def _coverage(self) -> xr.Dataset:
        """Return the present map: xarray keeps the accessor when variables are assigned."""
        inner = ("y", "x") if {"y", "x"} <= self._given.sizes.keys() else ()
        return self._given.transpose(..., *inner)

    def plot(self) -> Any:
        """Return the figure of `plot_coverage`."""
        return later(_PLOT)(self._coverage)

    def save(self, path: str | PathLike[str], **options: Any) -> None:
        """Write the map as `save_coverage` does, with its options."""
        later("export:save_coverage")(self._coverage, path, **options)

    def probability_above(self, threshold_db: float) -> xr.DataArray:
        """Return the probability (ny, nx) or (tx, ny, nx) that the path gain exceeds a threshold t [dB].

        P(gain > t) = p_los Phi((m_los - t) / s_los) + p_nlos Phi((m_nlos - t) / s_nlos) + p_outage (-150 > t), with m
        and s from `gain_los_mean_db`, `gain_los_std_db` etc., and the normal distribution function Phi. NaN where no
        receiver can be.

        Raises
        ------
        SettingsError
            For a threshold that is not a finite number.
        """
        transmitters_of(self._coverage)
        above = probability_above(self._coverage, threshold_db)
        attributes = {"long_name": f"probability of a path gain above {threshold_db:g} dB", "units": "1"}
        values = self._coverage["p_los"].copy(data=above.astype(np.float32))
        return values.rename(f"probability_above_{threshold_db:g}_db").assign_attrs(attributes)

    def power(
        self, *, eirp_dbm: ArrayLike = 20.0, rx_gain_db: float = 0.0, client_dbm: ArrayLike | None = None
    ) -> xr.Dataset:
        """Return the received power: EIRP + path gain + gain of the receiver's antenna.

        Parameters
        ----------
        eirp_dbm : float or (T,) array-like
            Equivalent isotropically radiated power [dBm], of all or each of the T transmitters.
        rx_gain_db : float
            Gain of the receiver's antenna [dB].
        client_dbm : float or (T,) array-like, optional
            Transmit power of the receiver, a client that answers, plus the gain of the transmitter's antenna that the
            coverage does not have [dBm]. With it the weaker direction counts: path gains are the same in both.

        Returns
        -------
        xarray.Dataset
            `power_mean_dbm` (outage: path gain -150 dB) and `power_std_db`.

        Raises
        ------
        SettingsError
            For a power or gain that is not a finite number.
        """
        return self._level("power", "dBm", self._offset_db(eirp_dbm, rx_gain_db, client_dbm))

    def snr(
        self,
        *,
        eirp_dbm: ArrayLike = 20.0,
        rx_gain_db: float = 0.0,
        client_dbm: ArrayLike | None = None,
        noise_figure_db: float = 7.0,
        bandwidth_hz: float = 100e6,
    ) -> xr.Dataset:
        """Return the SNR of the received `power` over -174 dBm/Hz + 10 log10(bandwidth) + noise figure.

        Returns
        -------
        xarray.Dataset
            `snr_mean_db` (outage: path gain -150 dB) and `snr_std_db`. `predict_network` includes interference.
        """
        budget = LinkBudget(noise_figure_db, bandwidth_hz)
        return self._level("snr", "dB", self._offset_db(eirp_dbm, rx_gain_db, client_dbm) - budget.noise_dbm)

    def rate(
        self,
        standard: str,
        *,
        eirp_dbm: ArrayLike = 20.0,
        rx_gain_db: float = 0.0,
        noise_figure_db: float = 7.0,
        bandwidth_hz: float = 80e6,
    ) -> xr.DataArray:
        """Return the mean rate [bit/s] of one spatial stream with adaptive modulation and coding.

        Parameters
        ----------
        standard : {"wifi6", "wifi7", "nr"}
            Wi-Fi: MCS 0 to 11 of IEEE 802.11ax, 0 to 13 of 802.11be, guard interval 0.8 us; required SNR from the
            receiver sensitivity at a noise figure of 10 dB. NR: MCS 0 to 28 of 3GPP TS 38.214, table 5.1.3.1-1;
            required SNR from 0.6 of the Shannon bound (TR 36.942, annex A), overhead of TS 38.306.
        bandwidth_hz : float
            Wi-Fi: 20, 40, 80, 160 and (802.11be, from 5.925 GHz) 320 MHz, up to 40 MHz below 3 GHz. NR: 5 to 100 MHz
            (FR1) or 50 MHz to 2 GHz (FR2).

        Raises
        ------
        SettingsError
            For a bandwidth that the standard lacks, or a frequency outside 1 to 7.125 GHz (802.11ax), 1 to 7.25 GHz
            (802.11be), 0.41 to 7.125 and 24.25 to 71 GHz (NR).
        """
        budget = LinkBudget(noise_figure_db, bandwidth_hz)
        offset_db = self._offset_db(eirp_dbm, rx_gain_db) - budget.noise_dbm
        mean, before = np.zeros(()), 0.0
        table = schemes(standard, bandwidth_hz, float(self._coverage.attrs["frequency_hz"]))
        for snr_db, rate_bit_s in table:
            mean = mean + (rate_bit_s - before) * self._probability_of(snr_db - offset_db)
            before = rate_bit_s
        attributes = {"long_name": f"mean rate of {standard}, {bandwidth_hz / 1e6:g} MHz", "units": "bit/s"}
        return self._coverage["p_los"].copy(data=np.float32(mean)).rename("rate_bit_s").assign_attrs(attributes)

    def area(
        self,
        threshold_dbm: float,
        *,
        probability: float = 0.9,
        eirp_dbm: ArrayLike = 20.0,
        rx_gain_db: float = 0.0,
        client_dbm: ArrayLike | None = None,
        any_transmitter: bool = False,
    ) -> xr.Dataset:
        """Return the covered fraction of the floor, as in "95 % above -67 dBm with probability 0.9".

        Parameters
        ----------
        threshold_dbm : float
            Received power [dBm], see `power`.
        probability : float
            Required probability of a receiver, in [0, 1].
        any_transmitter : bool
            Combine several transmitters by their largest probability.

        Returns
        -------
        xarray.Dataset
            On `floor`: "observed" (free cells), "all" (weighted by `p_indoor`; 1 in free cells) and the rooms of the
            map, with their number if a room has such a name ("all_1"). `fraction` has at least that probability,
            `fraction_mean` is the mean probability, `area_m2` the size. Fractions are NaN on an empty floor. Several
            transmitters are on `tx`, with one floor for all: any of them covers at least as much as each.
        """
        require_number("threshold_dbm", threshold_dbm, -400.0, 400.0)
        require_number("probability", probability, 0.0, 1.0)
        threshold_db = threshold_dbm - self._offset_db(eirp_dbm, rx_gain_db, client_dbm)
        above, dims = self._probability_of(threshold_db), ("floor", *self._coverage["p_los"].dims[:-2])
        above = np.where(np.isnan(above), threshold_db < 0.0, above)  # a receiver at a transmitter has 0 dB
        if any_transmitter and len(dims) > 1:
            above, dims = above.max(axis=0), dims[:1]
        weights = self._floors()
        total = weights.sum(axis=(-2, -1))
        with np.errstate(invalid="ignore"):
            shares = [
                np.einsum("fyx,...yx->f...", weights, each) / total.reshape(-1, *[1] * (len(dims) - 1))
                for each in (above >= probability, above)
            ]
        values: dict[str, Any] = {"fraction": (dims, shares[0]), "fraction_mean": (dims, shares[1])}
        values["area_m2"] = "floor", total * self._coverage.spacing_m**2
        coordinates: dict[str, Any] = {"floor": [*FLOORS, *self._rooms()]}
        coordinates |= {"tx": self._coverage["tx"]} if len(dims) > 1 else {}
        settings = {"threshold_dbm": float(threshold_dbm), "probability": float(probability)}
        return xr.Dataset(values, coordinates, settings)

    def _floors(self) -> Floats:
        """Return the weights (floor, ny, nx) of receivers in `area`, the same for all transmitters."""
        transmitters = tuple(range(self._coverage["valid"].ndim - 2))
        valid = (self._coverage["valid"].to_numpy() == 1).any(axis=transmitters)
        indoor = np.nan_to_num(self._coverage["p_indoor"].to_numpy()).max(axis=transmitters)
        free = self._coverage["cell_state"].to_numpy() == CellState.FREE
        of_rooms = [valid & free & room for room in self._rooms().values()]
        return np.stack([valid & free, np.where(valid, np.where(free, 1.0, indoor), 0.0), *of_rooms])

    def _rooms(self) -> dict[str, Bools]:
        if ROOM not in self._coverage:
            return {}
        room = self._coverage[ROOM]
        numbers = zip(str(room.attrs["flag_meanings"]).split(), room.attrs["flag_values"], strict=True)
        return {
            f"{name}_{number}" if name in FLOORS else name: room.to_numpy() == number
            for name, number in numbers
            if number
        }

    def _offset_db(self, eirp_dbm: ArrayLike, rx_gain_db: float, client_dbm: ArrayLike | None = None) -> Floats:
        maps = transmitters_of(self._coverage)
        require_number("rx_gain_db", rx_gain_db, -200.0, 200.0)
        offset_db = transmit_powers_dbm(eirp_dbm, len(maps), "eirp_dbm")
        if client_dbm is not None:
            offset_db = np.minimum(offset_db, transmit_powers_dbm(client_dbm, len(maps), "client_dbm"))
        offset_db = offset_db + rx_gain_db
        return offset_db[:, None, None] if "tx" in self._coverage.dims else offset_db[0]

    def _level(self, name: str, unit: str, offset_db: Floats) -> xr.Dataset:
        mean_db = self._coverage["gain_mean_db"]
        words = {"power": "received power", "snr": "SNR"}[name]
        attributes = {"long_name": f"mean {words}, an outage counting -150 dB of path gain", "units": unit}
        spread = {"long_name": f"standard deviation of the {words}", "units": "dB"}
        return xr.Dataset(
            {
                f"{name}_mean_{unit.lower()}": mean_db.copy(data=np.float32(mean_db + offset_db)).assign_attrs(
                    attributes
                ),
                f"{name}_std_db": self._coverage["gain_std_db"].assign_attrs(spread),
            }
        )

    def _probability_of(self, threshold_db: Floats) -> Floats:
        links = LinkPrediction.of_columns(lambda name: self._coverage[name].to_numpy())
        return links.probability_above(np.maximum(threshold_db, GAIN_FLOOR_DB))

    def radio_map(self, scene: Any, *, scene_offset_m: Sequence[float] = (0.0, 0.0)) -> Any:
        """Return the mean path gain as a radio map of Sionna RT; cells without receiver or in outage are empty.

        The transmitters of the coverage replace those in the scene.

        Parameters
        ----------
        scene : sionna.rt.Scene
            The scene of `export_scene`, loaded by `sionna.rt.load_scene`.
        scene_offset_m : (2,) or (3,) sequence of float
            `scene_offset` [m] in `map.yaml` of the exported scene; not 0 on maps far from the origin.

        Returns
        -------
        sionna.rt.PlanarRadioMap

        Raises
        ------
        SettingsError
            For anything but a scene.
        """
        plane, tx, maps = self._plane(scene_offset_m)
        return planar_radio_map(scene, plane, tx, np.stack([one["gain_mean_db"].to_numpy() for one in maps]))

    def stock_gain(self, scene: Any, *, scene_offset_m: Sequence[float] = (0.0, 0.0)) -> xr.DataArray:
        """Return the path gain [dB] of Sionna RT's `RadioMapSolver` in the exported scene, on the same grid.

        Settings and transmitters are taken from the coverage. Compare with `partial_gain_db`: the solver averages power
        over cells, misses rays, and counts crossed walls in the depth.

        Parameters
        ----------
        scene, scene_offset_m
            As in `radio_map`.

        Returns
        -------
        xarray.DataArray
            On (y, x) or (tx, y, x): -150 dB where no ray arrives, NaN where no receiver can be.

        Raises
        ------
        SettingsError
            For anything but a scene, or a transmitter at the height of the receivers.
        """
        plane, tx, maps = self._plane(scene_offset_m)
        settings = TraceSettings(**json.loads(maps[0].attrs["trace_settings"]))
        gain_db, like = stock_gain_db(scene, plane, tx, settings), self._coverage["partial_gain_db"]
        attributes = {"long_name": "path gain by the RadioMapSolver of Sionna RT", "units": "dB"}
        found = like.copy(data=np.float32(gain_db.reshape(like.shape))).where(self._coverage["valid"] == 1)
        return found.rename("stock_gain_db").assign_attrs(attributes)

    def _plane(self, scene_offset_m: Sequence[float]) -> tuple[MapPlane, dict[str, Floats], list[xr.Dataset]]:
        maps, offset_m = transmitters_of(self._coverage), np.array([*scene_offset_m, 0.0])[:3]
        x_m, y_m = (self._coverage[name].to_numpy() - offset_m[axis] for axis, name in enumerate("xy"))
        attributes = self._coverage.attrs
        plane = MapPlane(x_m, y_m, float(attributes["spacing_m"]), float(attributes["rx_height_m"] - offset_m[2]))
        tx = {name or "tx": np.subtract(one.attrs["transmitter_m"], offset_m) for name, one in maps.items()}
        return plane, tx, [*maps.values()]

    def at(self, x: float, y: float) -> xr.Dataset:
        """Return all variables at the receiver nearest to world x and y [m].

        Raises
        ------
        PositionError
            For a position off the map.
        """
        transmitters_of(self._coverage)
        half_m = float(self._coverage.attrs["spacing_m"]) / 2.0
        for name, value in (("x", x), ("y", y)):
            low_m, high_m = (float(self._coverage[name][end]) for end in (0, -1))
            if not low_m - half_m <= number_of(value) <= high_m + half_m:
                span = f"{low_m - half_m:g} to {high_m + half_m:g} m"
                raise PositionError(f"{name} = {shown(value)} is not on the map: give a number of metres in {span}.")
        return self._coverage.sel(x=x, y=y, method="nearest")

    def __repr__(self) -> str:
        maps = transmitters_of(self._coverage)
        sizes, attributes = self._coverage.sizes, self._coverage.attrs
        grid = f"{sizes['x']} x {sizes['y']} receivers, {attributes['spacing_m']:g} m apart"
        return f"<coverage: {grid}, {transmitter_text(maps)}, {attributes['frequency_hz'] / 1e9:g} GHz>"

    def _repr_html_(self) -> str:
        return picture_html(repr(self), _PLOT, self._coverage)
