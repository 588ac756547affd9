"""Traced links: the paths of every link in arrays, and as tables."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, States, read_only
from sionna_partial.checks import require_choice
from sionna_partial.constants import GAIN_FLOOR_DB, MEMORY_GB, NO_RECEIVER
from sionna_partial.display import Shown
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.interactions import REFRACTION
from sionna_partial.tracing.paths import SolvedPaths

if TYPE_CHECKING:
    import xarray as xr

    from sionna_partial.tracing.array_paths import ArrayPaths


@read_only
@dataclass(frozen=True)
class TracedLinks(Shown):
    """All traced paths from one or T transmitters to N receivers, by transmitter, receiver and delay.

    Parameters
    ----------
    tx : (3,) or (T, 3) float64 array
        Transmitter positions [m].
    rx : (N, 3) float64 array
        Receiver positions [m].
    link_state : (N,) or (T, N) uint8 array of LinkState
        255 where a link was not traced (``invalid="nan"``).
    gain_db : (N,) or (T, N) float64 array
        Omnidirectional path gain [dB], at least -150 (paper, eq. 5); NaN where not traced.
    path_tx, path_rx : (P,) int32 arrays
        Transmitter and receiver of each path.
    transfer : (P, 2, 2) complex128 array
        Transfer matrix between isotropic antennas: [at the receiver, at the transmitter] along the unit vectors theta
        and phi of arrival and departure, without the phase -2 pi f delay_s.
    delay_s : (P,) float64 array
        Propagation delay [s].
    departure_rad, arrival_rad : (P, 2) float64 arrays
        Zenith and azimuth of departure and arrival [rad].
    interactions : (P, D) uint8 array
        Sionna RT's `InteractionType` in order from the transmitter; 0 for none.
    vertices_m : (P, D, 3) float64 array
        Points of interaction [m]; NaN for none.
    trace_settings : TraceSettings
        With values in place of None.
    scene_settings : SceneSettings
        With the map's material, if it has one.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> links = sp.trace_links(partial, (1.5, 1.5, 1.5), [(3.0, 2.0, 1.5), (3.5, 1.5, 1.5)])
    >>> links.link_state.tolist(), links.path_rx.max().item()
    ([1, 1], 1)
    """

    tx: Floats
    rx: Floats
    link_state: States
    gain_db: Floats
    path_tx: NDArray[np.int32]
    path_rx: NDArray[np.int32]
    transfer: NDArray[np.complex128]
    delay_s: Floats
    departure_rad: Floats
    arrival_rad: Floats
    interactions: NDArray[np.uint8]
    vertices_m: Floats
    trace_settings: TraceSettings
    scene_settings: SceneSettings

    @property
    def a(self) -> NDArray[np.complex128]:
        """Complex path gain (P,) between isotropic, vertically polarised antennas."""
        return self.transfer[:, 0, 0]

    @property
    def valid(self) -> Bools:
        """True for traced links, (N,) or (T, N); False only with ``invalid="nan"``."""
        return self.link_state != NO_RECEIVER

    @property
    def path_link(self) -> NDArray[np.int64]:
        """Index (P,) of the link of each path in the flattened `gain_db`."""
        return self.solved.link(len(self.rx))

    @property
    def solved(self) -> SolvedPaths:
        """The paths without their links."""
        return SolvedPaths(*(getattr(self, field.name) for field in fields(SolvedPaths)))

    def array_paths(self, **arrays: Any) -> ArrayPaths:
        """Return the paths between antenna arrays, given by the arguments of `cir`."""
        from sionna_partial.tracing.array_paths import ArrayPaths

        return ArrayPaths.of(self.solved, self.tx.reshape(-1, 3), self.rx, self.trace_settings, **arrays)

    def cir(
        self,
        *,
        tx_array: Any = None,
        rx_array: Any = None,
        tx_orientation_rad: ArrayLike | None = None,
        rx_orientation_rad: ArrayLike | None = None,
        synthetic_array: bool = True,
        normalize_delays: bool = True,
        memory_gb: float = MEMORY_GB,
    ) -> xr.Dataset:
        """Return the channel impulse response of each link, as `sionna.rt.Paths.cir` does.

        Channels have the paths of the links, which lack weak ones within ``TraceSettings.power_tolerance_db``, the
        attribute `power_tolerance_db` of the result. `Simulation.with_every_path`, or a trace with a tolerance of 0,
        has all.

        Parameters
        ----------
        tx_array, rx_array : sionna.rt.PlanarArray, optional
            By default one isotropic, vertically polarised antenna.
        tx_orientation_rad : (3,) or (T, 3) array-like, optional
            Rotation angles about z, y and x [rad], as in Sionna RT.
        rx_orientation_rad : (3,) or (N, 3) array-like, optional
        synthetic_array : bool
            True: plane waves at the arrays. False: exact path lengths between antennas, with patterns and reflection
            coefficients of the centres.
        normalize_delays : bool
            Count delays from the shortest path of each link.
        memory_gb : float
            Largest memory of result and work [GB].

        Returns
        -------
        xarray.Dataset
            `a` (link, rx_ant, tx_ant, path): complex baseband gains a exp(-j 2 pi f delay), 0 without a path.
            `delay_s` (link, path), or as `a` unless `synthetic_array`: NaN without a path. `paths` (link): number of
            paths. Link ``tx * N + rx`` has coordinates `tx` and `rx`.

        Raises
        ------
        SettingsError
            For an invalid array, or orientations of another shape.
        MemoryLimitError
            If the result would take more than `memory_gb`.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> from sionna.rt import PlanarArray
        >>> links = sp.trace_links(sp.make_home(3), (2.0, 3.0, 1.5), [(2.5, 3.0, 1.5), (3.0, 3.0, 1.5)])
        >>> array = PlanarArray(num_rows=8, num_cols=8, pattern="tr38901", polarization="VH")
        >>> channels = links.cir(tx_array=array)
        >>> channels.sizes["link"], channels.sizes["tx_ant"]
        (2, 128)
        """
        from sionna_partial.tracing.responses import cir

        arrays = self.array_paths(
            tx_array=tx_array,
            rx_array=rx_array,
            tx_orientation_rad=tx_orientation_rad,
            rx_orientation_rad=rx_orientation_rad,
            synthetic_array=synthetic_array,
            normalize_delays=normalize_delays,
        )
        return cir(arrays, memory_gb)

    def cfr(self, frequencies_hz: ArrayLike, *, memory_gb: float = MEMORY_GB, **arrays: Any) -> xr.Dataset:
        """Return the channel frequency response of each link, as `sionna.rt.Paths.cfr` does.

        Parameters
        ----------
        frequencies_hz : (F,) array-like
            Frequencies relative to the carrier [Hz].
        memory_gb : float
            As in `cir`.
        **arrays
            Other arguments of `cir`.

        Returns
        -------
        xarray.Dataset
            `h` (link, rx_ant, tx_ant, frequency), complex.

        Raises
        ------
        SettingsError, MemoryLimitError
            As `cir`, and for frequencies of another shape or not below the carrier's.

        Examples
        --------
        >>> import numpy as np
        >>> import sionna_partial as sp
        >>> links = sp.trace_links(sp.make_home(3), (2.0, 3.0, 1.5), [(2.5, 3.0, 1.5)])
        >>> links.cfr(np.arange(-32, 32) * 120e3).h.shape
        (1, 1, 1, 64)
        """
        from sionna_partial.tracing.responses import cfr

        return cfr(self.array_paths(**arrays), frequencies_hz, memory_gb)

    def taps(
        self,
        bandwidth_hz: float,
        l_min: int = -6,
        l_max: int | None = None,
        *,
        memory_gb: float = MEMORY_GB,
        **arrays: Any,
    ) -> xr.Dataset:
        """Return the channel taps of each link at a bandwidth, as `sionna.rt.Paths.taps` does.

        Parameters
        ----------
        bandwidth_hz : float
            Bandwidth, and sampling rate, of the sinc filter [Hz].
        l_min, l_max : int
            First and last tap; by default, the last is six after the longest delay.
        memory_gb : float
            As in `cir`.
        **arrays
            Other arguments of `cir`.

        Returns
        -------
        xarray.Dataset
            `h` (link, rx_ant, tx_ant, tap), complex.

        Raises
        ------
        SettingsError, MemoryLimitError
            As `cir`, and for a bandwidth or taps out of range.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> links = sp.trace_links(sp.make_home(3), (2.0, 3.0, 1.5), [(2.5, 3.0, 1.5)])
        >>> links.taps(100e6, l_max=20).sizes["tap"]
        27
        """
        from sionna_partial.tracing.responses import taps

        return taps(self.array_paths(**arrays), bandwidth_hz, l_min, l_max, memory_gb)

    def beam_gains(
        self,
        codebook: ArrayLike,
        rx_codebook: ArrayLike | None = None,
        *,
        tx_array: Any = None,
        rx_array: Any = None,
        tx_orientation_rad: ArrayLike | None = None,
        rx_orientation_rad: ArrayLike | None = None,
        memory_gb: float = MEMORY_GB,
    ) -> xr.Dataset:
        """Return the gain of every pair of beams of each link.

        The gain of beams w and u is the sum of ``|u^H A w|^2`` over the paths, with coefficients A as in `cir` for
        plane waves: the mean over a wide band, as `gain_db`. The matrices A are not formed.

        Parameters
        ----------
        codebook : (C, tx_ant) array-like
            Weights of the transmitting antennas, one beam in each row, as from `dft_codebook`.
        rx_codebook : (B, rx_ant) array-like, optional
            Weights of the receiving antennas. By default each antenna alone.
        tx_array, rx_array, tx_orientation_rad, rx_orientation_rad, memory_gb
            As in `cir`.

        Returns
        -------
        xarray.Dataset
            `gain_db` (link, rx_beam, tx_beam), at least -150 dB; `best_rx_beam` and `best_tx_beam` (link), -1 without
            paths; `margin_db` (link) to the next pair, NaN without paths or for a single pair.

        Raises
        ------
        SettingsError, MemoryLimitError
            As `cir`, and for weights of another shape.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> from sionna.rt import PlanarArray
        >>> links = sp.trace_links(sp.make_home(3), (2.0, 3.0, 1.5), [(2.5, 3.0, 1.5)])
        >>> array = PlanarArray(num_rows=4, num_cols=4, pattern="iso", polarization="V")
        >>> beams = links.beam_gains(sp.channels.dft_codebook(4, 4), tx_array=array)
        >>> beams.best_tx_beam.item()  # broadside
        0
        """
        from sionna_partial.tracing.responses import beam_gains

        arrays = self.array_paths(
            tx_array=tx_array,
            rx_array=rx_array,
            tx_orientation_rad=tx_orientation_rad,
            rx_orientation_rad=rx_orientation_rad,
        )
        return beam_gains(arrays, codebook, rx_codebook, memory_gb)

    def to_xarray(self) -> xr.Dataset:
        """Return the links and their paths as a labelled Dataset.

        Dimensions are "rx", "tx" for several transmitters, "path" and "interaction"; variables have `units`,
        settings are attributes.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> links = sp.trace_links(sp.make_home(3), (2.0, 3.0, 1.5), [(2.5, 3.0, 1.5), (3.0, 3.0, 1.5)])
        >>> links.to_xarray().sizes["rx"], links.to_xarray().gain_db.units
        (2, 'dB')
        """
        import xarray as xr

        link = ("tx", "rx")[2 - self.gain_db.ndim :]
        shapes = {
            **{"tx": (*link[:-1], "axis"), "rx": ("rx", "axis"), "link_state": link, "gain_db": link},
            **dict.fromkeys(("departure_rad", "arrival_rad"), ("path", "angle")),
            **{"interactions": ("path", "interaction"), "vertices_m": ("path", "interaction", "axis")},
            "transfer": ("path", "at_rx", "at_tx"),
        }
        names = [*(field.name for field in fields(self) if not field.name.endswith("settings")), "a"]
        along = ["theta", "phi"]
        axes = {"axis": ["x", "y", "z"], "angle": ["zenith", "azimuth"], "at_rx": along, "at_tx": along}
        variables = {}
        for name in names:
            about = dict(zip(("long_name", "units"), _VARIABLES[name], strict=True))
            own_name = f"{name}_m" if name in ("tx", "rx") else name
            variables[own_name] = shapes.get(name, ("path",)), getattr(self, name), about
        attributes = {"frequency_hz": self.trace_settings.frequency_hz, "gain_floor_db": GAIN_FLOOR_DB}
        table = xr.Dataset(variables, axes, attributes)
        for name in ("trace_settings", "scene_settings"):
            table.attrs[name] = json.dumps(asdict(getattr(self, name)), sort_keys=True)
        return table

    def spreads(self) -> xr.Dataset:
        """Return delay and angular spreads, K-factor and path loss of each link.

        Weights are ``|a|^2``, between isotropic, vertically polarised antennas.

        Returns
        -------
        xarray.Dataset
            On "rx", and "tx" for several transmitters. `path_loss_db`; `k_factor_db`, the line of sight over all other
            paths (NaN without line of sight); `delay_spread_s`; and the circular standard deviations
            `zenith_departure_spread_rad`, `azimuth_departure_spread_rad`, `zenith_arrival_spread_rad` and
            `azimuth_arrival_spread_rad`. NaN without paths.

        Notes
        -----
        Source: 3GPP TR 38.901, section 7.5 (delay spread, K-factor) and annex A.1 (angular spread
        ``sqrt(-2 ln |sum P exp(j angle) / sum P|)``).

        Examples
        --------
        >>> import sionna_partial as sp
        >>> links = sp.trace_links(sp.make_home(3), (2.0, 3.0, 1.5), [(2.5, 3.0, 1.5)])
        >>> bool(links.spreads().k_factor_db > 0)
        True
        """
        from sionna_partial.tracing.responses import spreads

        return spreads(self.solved, self.gain_db)

    def to_dataframe(self, of: Literal["links", "paths"] = "links") -> Any:
        """Return a row for each link, or for each path, as a pandas.DataFrame.

        Parameters
        ----------
        of : {"links", "paths"}
            Columns of links: `tx`, `rx`, positions [m], `link_state`, `gain_db`, `distance_m`, number of `paths` and
            shortest `delay_s` (NaN without paths). Columns of paths: `tx`, `rx`, `gain_db`, `phase_rad`, `delay_s`,
            angles [rad], `interactions` by Sionna RT's `InteractionType`, such as "1-1-8", and number of `walls`
            crossed.

        Raises
        ------
        SettingsError
            For another value of `of`.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> links = sp.trace_links(sp.make_home(3), (2.0, 3.0, 1.5), [(2.5, 3.0, 1.5), (3.0, 3.0, 1.5)])
        >>> links.to_dataframe().distance_m.tolist()
        [0.5, 1.0]
        """
        import xarray as xr

        require_choice("of", of, ("links", "paths"))
        columns = self._link_columns() if of == "links" else self._path_columns()
        table = xr.Dataset({name: ("row", values) for name, values in columns.items()})
        return table.to_dataframe().reset_index(drop=True)

    def _link_columns(self) -> dict[str, NDArray[Any]]:
        tx_m, count = self.tx.reshape(-1, 3), len(self.rx)
        tx, rx = np.repeat(np.arange(len(tx_m)), count), np.tile(np.arange(count), len(tx_m))
        link = self.path_link
        first, paths = np.unique(link, return_index=True, return_counts=True)[1:]  # the shortest is listed first
        delay_s, number = np.full(len(tx), np.nan), np.zeros(len(tx), np.int64)
        delay_s[link[first]], number[link[first]] = self.delay_s[first], paths
        ends = {"tx": tx_m[tx], "rx": self.rx[rx]}
        return {
            **{"tx": tx, "rx": rx},
            **{f"{end}_{axis}_m": at for end, at_m in ends.items() for axis, at in zip("xyz", at_m.T, strict=True)},
            **{"link_state": self.link_state.ravel(), "gain_db": self.gain_db.ravel()},
            **{"distance_m": np.linalg.norm(ends["rx"] - ends["tx"], axis=1), "paths": number, "delay_s": delay_s},
        }

    def _path_columns(self) -> dict[str, NDArray[Any]]:
        angles = {"departure": self.departure_rad, "arrival": self.arrival_rad}
        types = ["-".join(str(kind) for kind in row if kind) for row in self.interactions.tolist()]
        return {
            **{"tx": self.path_tx, "rx": self.path_rx},
            **{"gain_db": 20.0 * np.log10(np.abs(self.a)), "phase_rad": np.angle(self.a), "delay_s": self.delay_s},
            **{f"{end}_zenith_rad": values[:, 0] for end, values in angles.items()},
            **{f"{end}_azimuth_rad": values[:, 1] for end, values in angles.items()},
            "interactions": np.array(types, dtype=object),
            "walls": (self.interactions == REFRACTION).sum(axis=1),
        }


_VARIABLES = {
    "tx": ("transmitter position", "m"),
    "rx": ("receiver position", "m"),
    "link_state": ("link state: 0 outage, 1 LOS, 2 NLOS, 255 not traced", "1"),
    "gain_db": ("omnidirectional path gain", "dB"),
    "path_tx": ("transmitter of the path", "1"),
    "path_rx": ("receiver of the path", "1"),
    "transfer": ("transfer matrix of the path between isotropic antennas", "1"),
    "a": ("complex path gain between isotropic, vertically polarised antennas", "1"),
    "delay_s": ("propagation delay", "s"),
    "departure_rad": ("angles of departure", "rad"),
    "arrival_rad": ("angles of arrival", "rad"),
    "interactions": ("Sionna RT's InteractionType in order from the transmitter, 0 for none", "1"),
    "vertices_m": ("points of interaction", "m"),
}
"""Descriptions and units of the variables of `to_xarray`."""
