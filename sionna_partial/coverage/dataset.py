"""Variables of the coverage maps of `predict_map`, and the accessor ``coverage.radio``."""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from os import PathLike
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import float_array, number_of, require, require_names, require_number, shown
from sionna_partial.constants import GAIN_FLOOR_DB, MAX_COST, NO_RECEIVER, CellState, LinkState
from sionna_partial.coverage.link_budget import LinkBudget, schemes, transmit_powers_dbm
from sionna_partial.display import later, picture_html
from sionna_partial.errors import PositionError, SettingsError
from sionna_partial.measurements.localisation import TransmitterPosterior
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.predictor import AnyPredictor, LinkPrediction
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.antennas import MAX_GAIN_DBI
from sionna_partial.tracing.simulation import Simulation
from sionna_partial.tracing.stock import MapPlane, planar_radio_map, stock_gain_db

WALL_PARTS = 6
"""Parts of a cell along each axis: pictures show walls thinner than a cell."""

DISTRIBUTION = ("p_los", "p_nlos", "p_outage", "gain_mean_db", "gain_std_db")
COMPONENTS = ("gain_los_mean_db", "gain_los_std_db", "gain_nlos_mean_db", "gain_nlos_std_db")

TX_COORDINATES = ("tx_x", "tx_y", "tx_z")
"""Positions [m] along the dimension "tx"."""

ROOM = "room"
"""Variable with the room of each receiver: flags, 0 for none."""

WALLS = "wall_material"
"""Attribute: probabilities of unknown materials."""

ANTENNA, OFFSET = "tx_antenna", "measured_offset_db"
"""Antenna, offset of measured powers [dB]: attributes for one transmitter, coordinates along "tx" for several."""

FLOORS = ("observed", "all")
"""Floors of `radio.area` besides the rooms of the map."""

_OF_ALL = ("observed", "cell_state", "wall_parts", ROOM)

_LOWEST = {"spacing_m": 0.0, "frequency_hz": 0.0, "rx_height_m": -1e15}
"""Required attributes and their lower limits."""

_RANGES = {"1": (0.0, 1.0), "dB": (GAIN_FLOOR_DB, 10.0 + MAX_GAIN_DBI), "std": (0.0, 1e3), "m": (0.0, 1e15)}
"""Ranges of probabilities, gains (near the transmitter above 0 dB), standard deviations and lengths."""

_PLOT = "plots.coverage_plot:plot_coverage"


def flags(meanings: Mapping[str, int], kind: type[np.integer[Any]] = np.uint8) -> dict[str, Any]:
    return {"flag_values": np.array([*meanings.values()], dtype=kind), "flag_meanings": " ".join(meanings)}


_LINK_FLAGS = flags({**{state.name.lower(): state for state in LinkState}, "no_receiver": NO_RECEIVER})
_CELL_FLAGS = flags({state.name.lower(): state for state in CellState})
_YES_NO = flags({"no": 0, "yes": 1}, np.int8)

ATTRIBUTES: Mapping[str, Mapping[str, Any]] = {
    "p_los": {"long_name": "probability of line of sight", "units": "1"},
    "p_nlos": {"long_name": "probability of paths without line of sight", "units": "1"},
    "p_outage": {"long_name": "probability of outage", "units": "1"},
    "link_state": {"long_name": "most probable link state", **_LINK_FLAGS},
    "gain_mean_db": {"long_name": "mean omnidirectional path gain, an outage counting -150 dB", "units": "dB"},
    "gain_std_db": {"long_name": "standard deviation of the omnidirectional path gain", "units": "dB"},
    "gain_los_mean_db": {"long_name": "mean path gain given line of sight", "units": "dB"},
    "gain_los_std_db": {"long_name": "standard deviation of the path gain given line of sight", "units": "dB"},
    "gain_nlos_mean_db": {"long_name": "mean path gain given no line of sight", "units": "dB"},
    "gain_nlos_std_db": {"long_name": "standard deviation of the path gain given no line of sight", "units": "dB"},
    "p_indoor": {"long_name": "probability that the receiver is indoors", "units": "1"},
    "partial_link_state": {"long_name": "link state traced on the known part of the map", **_LINK_FLAGS},
    "partial_gain_db": {"long_name": "path gain traced on the known part of the map", "units": "dB"},
    "unobserved_distance_m": {"long_name": "length of the direct line in unknown cells", "units": "m"},
    "distance_m": {"long_name": "distance from the transmitter", "units": "m"},
    "observed": {"long_name": "whether this cell was observed", **_YES_NO},
    "valid": {"long_name": "whether a receiver can stand here", **_YES_NO},
    "cell_state": {"long_name": "state of the map at the receiver", **_CELL_FLAGS},
    "wall_parts": {
        "long_name": "walls within the cell",
        "comment": f"Bit {WALL_PARTS} * row + column is set where that one of {WALL_PARTS} x {WALL_PARTS} parts of "
        "the cell holds a wall; row 0 has the smallest y, column 0 the smallest x.",
    },
}
"""Variables on (y, x) and their CF attributes."""


def link_columns(
    phi: LinkFeatures, prediction: LinkPrediction, p_indoor: Floats, *, anywhere: bool
) -> dict[str, NDArray[Any]]:
    if anywhere:
        prediction = prediction.anywhere(p_indoor)
    columns = {name: getattr(prediction, name) for name in (*DISTRIBUTION, *COMPONENTS)} | {
        "p_indoor": p_indoor,
        "partial_gain_db": phi.gain_db,
        "unobserved_distance_m": phi.unobserved_distance_m,
        "distance_m": phi.distance_m,
    }
    columns = {name: values.astype(np.float32) for name, values in columns.items()}
    return columns | {"link_state": prediction.link_state, "partial_link_state": phi.link_state}


@cache
def _versions() -> str:
    """Return names and versions of the packages; reading them takes memory, hence the cache."""
    versions = {}
    for package in ("sionna-partial", "sionna-rt", "mitsuba", "drjit", "keras", "numpy", "xarray"):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return ", ".join(f"{package} {number}" for package, number in versions.items())


def provenance(simulation: Simulation, model: AnyPredictor | None) -> dict[str, Any]:
    """Return the global attributes; no time of day, so that equal input gives equal files."""
    partial, (trace_settings, scene_settings) = simulation.partial, simulation.resolved
    return {
        "Conventions": "CF-1.11",
        "title": "Predicted radio coverage of a partially observed environment",
        "source": _versions(),
        "history": "sionna_partial.predict_map",
        "references": "Yin et al., Wireless Channel Prediction in Partially Observed Environments",
        "frequency_hz": float(trace_settings.frequency_hz),
        "gain_floor_db": GAIN_FLOOR_DB,
        "walls": "through walls" if trace_settings.through_walls else "opaque walls",
        "map_resolution_m": partial.resolution_m,
        "map_wall_height_m": partial.wall_height_m,
        "map_observed_fraction": partial.observed_fraction,
        "map_complete": int(model is None),
        "scene_settings": json.dumps(asdict(scene_settings), sort_keys=True),
        "trace_settings": json.dumps(asdict(trace_settings), sort_keys=True),
        "predictor": "none: the map is complete, the trace is the prediction" if model is None else model.name,
        "predictor_sha256": "" if model is None else model.fingerprint,
    }


def with_posterior(coverage: xr.Dataset, posterior: TransmitterPosterior) -> xr.Dataset:
    axes = {
        f"tx_{name}": (f"tx_{name}", values, {"long_name": f"{name} of the transmitter", "units": "m"})
        for name, values in (("x", posterior.x_m), ("y", posterior.y_m))
    }
    attributes = {"long_name": "probability of the transmitter's position", "units": "1"}
    coverage = coverage.assign_coords(axes)
    coverage["p_transmitter"] = ("tx_y", "tx_x"), posterior.probability, attributes
    return coverage.assign_attrs(transmitter_std_m=posterior.std_m)


def join_transmitters(maps: list[xr.Dataset], names: list[str]) -> xr.Dataset:
    positions_m = np.array([each.attrs.pop("transmitter_m") for each in maps])
    antennas = "tx", [each.attrs.pop(ANTENNA) for each in maps]
    coordinates: dict[str, Any] = {
        name: ("tx", column, {"units": "m"}) for name, column in zip(TX_COORDINATES, positions_m.T, strict=True)
    }
    of_all = [name for name in _OF_ALL if name in maps[0]]
    measured = [each.attrs.pop("measured_links", 0) for each in maps]
    offsets_db = "tx", [each.attrs.pop(OFFSET, np.nan) for each in maps], {"units": "dB"}
    # for a transmitter that nothing unknown can reach, the map is complete
    predicted = next((each.attrs for each in maps if not each.attrs["map_complete"]), maps[0].attrs)
    of_any = {name: predicted[name] for name in ("map_complete", "predictor", "predictor_sha256")}
    walls = [*dict.fromkeys(each.attrs[WALLS] for each in maps if WALLS in each.attrs)]
    of_any |= {WALLS: "; ".join(walls)} if walls else {}
    joined = xr.concat([each.drop_vars(of_all) for each in maps], "tx", combine_attrs="drop_conflicts")
    joined = joined.assign_attrs(of_any)
    if any(measured):
        joined, coordinates = joined.assign_attrs(measured_links=sum(measured)), coordinates | {OFFSET: offsets_db}
    return joined.assign({name: maps[0][name] for name in of_all}).assign_coords(
        {"tx": names, ANTENNA: antennas, **coordinates}
    )


def named_transmitter(coverage: xr.Dataset, name: str) -> xr.Dataset:
    """Return the coverage of one transmitter as that of several, with one name."""
    bare = require_coverage(coverage).copy()
    return join_transmitters([bare.drop_dims([each for each in ("tx_x", "tx_y") if each in bare.dims])], [name])


def require_coverage(coverage: xr.Dataset) -> xr.Dataset:
    """Return the coverage of one transmitter with `transmitter_m` in its attributes, or raise a SettingsError."""
    remedy = "give the xarray.Dataset that predict_map returned, or load it from its .nc file."
    kind = type(coverage).__name__
    if not isinstance(coverage, xr.Dataset):
        raise SettingsError(f"coverage is of type {kind}: {remedy}")
    if "tx" in coverage.dims:
        names = ", ".join(map(str, coverage["tx"].to_numpy()))
        raise SettingsError(f"coverage has the transmitters {names}: choose one, as by coverage.isel(tx=0).")
    if {"tx", *TX_COORDINATES} <= coverage.coords.keys():
        position_m = np.array([float(coverage[name]) for name in TX_COORDINATES])
        if ANTENNA in coverage.coords:
            coverage = coverage.assign_attrs({ANTENNA: str(coverage[ANTENNA].to_numpy())}).drop_vars(ANTENNA)
        coverage = coverage.drop_vars(("tx", *TX_COORDINATES)).assign_attrs(transmitter_m=position_m)
    missing = [name for name in ATTRIBUTES if name not in coverage or coverage[name].dims != ("y", "x")]
    missing += [name for name in ("x", "y") if name not in coverage.coords]
    missing += [name for name in ("transmitter_m", *_LOWEST) if name not in coverage.attrs]
    if missing or not coverage["valid"].size:
        raise SettingsError(f"coverage lacks {', '.join(missing) or 'receivers'}: {remedy}")
    for name, attributes in ATTRIBUTES.items():
        kinds = "f" if "units" in attributes else "biuf" if name.endswith("link_state") else "biu"
        require(coverage[name].dtype.kind in kinds, f"coverage.{name}", coverage[name].dtype, remedy)
    for name, lowest in _LOWEST.items():
        require_number(f"coverage.{name}", coverage.attrs[name], lowest, 1e15, open_low=True)
    position_m = float_array("coverage.transmitter_m", coverage.attrs["transmitter_m"], SettingsError, remedy)
    known = position_m.shape == (3,) and bool(np.isfinite(position_m).all())
    require(known, "coverage.transmitter_m", coverage.attrs["transmitter_m"], remedy)
    _require_values(coverage)
    return coverage


def _require_values(coverage: xr.Dataset) -> None:
    for name in ("x", "y"):
        steps_m = np.diff(np.asarray(coverage[name], dtype=np.float64))
        regular = bool((np.abs(steps_m - coverage.attrs["spacing_m"]) < 1e-3 * coverage.attrs["spacing_m"]).all())
        remedy = f"its step is spacing_m, ascending, as after coverage.sortby('{name}')."
        require(regular and bool(np.isfinite(coverage[name]).all()), f"coverage.{name}", steps_m, remedy)
    valid = coverage["valid"].to_numpy() == 1
    for name, attributes in ATTRIBUTES.items():
        values = coverage[name].to_numpy()
        if "flag_values" in attributes:
            good = np.isin(values, attributes["flag_values"]) | np.isnan(values)
            remedy = f"it is one of {[*attributes['flag_values']]}."
        elif "units" in attributes:
            low, high = _RANGES["std" if "_std_" in name else attributes["units"]]
            good = ~valid | ((values >= low) & (values <= high))
            remedy = f"it lies between {low:g} and {high:g} where a receiver can stand."
        else:
            continue
        require(bool(good.all()), f"coverage.{name}", values[~good][:1], remedy)
    total = sum(coverage[name].to_numpy()[valid] for name in ("p_los", "p_nlos", "p_outage"))
    wrong = np.abs(total - 1.0) > 1e-3
    require(not wrong.any(), "p_los + p_nlos + p_outage", total[wrong][:1], "probabilities of coverage sum to 1.")


def transmitters_of(coverage: xr.Dataset) -> dict[str, xr.Dataset]:
    if not isinstance(coverage, xr.Dataset) or "tx" not in coverage.dims:
        return {"": require_coverage(coverage)}
    names = [str(name) for name in coverage["tx"].to_numpy()]
    require_names("coverage.tx", names)
    return {name: require_coverage(coverage.isel(tx=at)) for at, name in enumerate(names)}


def probability_above(coverage: xr.Dataset, threshold_db: float) -> Floats:
    """Return P(path gain > threshold) (..., ny, nx), NaN without receiver; threshold in [-150, 0] dB."""
    require_number("threshold_db", threshold_db, GAIN_FLOOR_DB, 0.0)
    return LinkPrediction.of_columns(lambda name: coverage[name].to_numpy()).probability_above(threshold_db)


def cost_grid(
    axes_m: tuple[Floats, Floats], spacing_m: float, p_below: Floats, points_m: Floats, max_cost: int = MAX_COST
) -> NDArray[np.int8]:
    """Return costs (...) of points (..., 2) [m] for a planner: the probability at the nearest receiver in percent.

    `p_below` (ny, nx) is the probability of too small a gain at receivers with `axes_m` y (ny,) and x (nx,) [m]; NaN
    without receiver. Costs are at most `max_cost`, and -1 where no receiver is within two spacings.
    """
    percent = np.minimum(np.rint(100.0 * p_below), max_cost)
    valid = np.isfinite(percent)
    apart, nearest = distance_transform_edt(~valid, return_indices=True)
    known = np.where(valid.any() & (apart < 2.0), np.nan_to_num(percent)[tuple(nearest)], -1.0)
    cells, inside = [], np.ones(points_m.shape[:-1], dtype=bool)
    for axis_m, each_m in zip(axes_m, (points_m[..., 1], points_m[..., 0]), strict=True):
        index = np.rint((each_m - axis_m[0]) / spacing_m).astype(np.intp)
        cells.append(np.clip(index, 0, len(axis_m) - 1))
        inside &= np.abs(index - cells[-1]) < 2
    return np.where(inside, known[tuple(cells)], -1.0).astype(np.int8)


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


def transmitter_text(maps: Mapping[str, xr.Dataset]) -> str:
    if len(maps) > 1:
        return f"{len(maps)} transmitters"
    (coverage,) = maps.values()
    position = ", ".join(f"{each:z.2f}" for each in coverage.attrs["transmitter_m"])
    antenna = str(coverage.attrs.get(ANTENNA, "iso"))
    if "p_transmitter" in coverage:
        position = f"near ({position}) m, ± {coverage.attrs['transmitter_std_m']:.1f} m"
    else:
        position = f"at ({position}) m"
    return f"transmitter {position}" + (f", {antenna}" if antenna != "iso" else "")
