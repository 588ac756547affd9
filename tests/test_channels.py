"""Channel responses: against stock Sionna RT on the same paths, and against traces from antenna to antenna."""

import functools
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from test_trace import _room
from traced import made_links

import sionna_partial as sp
from sionna_partial.channels.files import load_channels, save_channels
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.errors import MemoryLimitError, OutputError, SettingsError
from sionna_partial.llvm import load_sionna
from sionna_partial.scene.export import export_scene
from sionna_partial.tracing import array_paths, responses
from sionna_partial.tracing.antennas import dft_codebook
from sionna_partial.tracing.interactions import DIFFRACTION

TX = np.array([1.03, 2.93, 1.4])
RX = np.array([[2.21, 1.12, 1.2], [5.02, 2.03, 1.5], [1.9, 3.1, 1.9]])
TX_RAD, RX_RAD = (0.4, -0.3, 0.2), ((0.0, 0.0, 0.0), (1.0, 0.2, -0.5), (2.1, -0.7, 0.3))
ORIENTATIONS = {"tx_orientation_rad": TX_RAD, "rx_orientation_rad": RX_RAD}


def array_of(rows: int, columns: int, pattern: str = "iso", polarization: str = "V", spacing: float = 0.5) -> Any:
    rt = load_sionna()
    shape = {"num_rows": rows, "num_cols": columns, "vertical_spacing": spacing, "horizontal_spacing": spacing}
    if pattern != "complex":
        return rt.PlanarArray(**shape, pattern=pattern, polarization=polarization)
    import mitsuba as mi

    array = rt.PlanarArray(**shape, pattern="iso", polarization=polarization)
    iso = array.antenna_pattern.patterns
    turned = mi.Complex2f(0.6, 0.8)
    array.antenna_pattern.patterns = [
        lambda theta, phi, each=each: (each(theta, phi)[0] * turned, each(theta, phi)[1]) for each in iso
    ]
    return array


@functools.cache
def links_of(depth: int, *, diffraction: bool = False) -> sp.TracedLinks:
    settings = sp.TraceSettings(28e9, depth, power_tolerance_db=0.0, diffraction=diffraction, open_ends=True)
    return sp.trace_links(_room(), TX, RX, trace_settings=settings)


@pytest.fixture(scope="module")
def room_xml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_scene(_room(), tmp_path_factory.mktemp("room") / "scene") / "scene.xml"


def stock_paths(xml: Path, depth: int, arrays: dict[str, Any], *, synthetic: bool, diffraction: bool = False) -> Any:
    """Paths of the public solver between the same ends."""
    rt = load_sionna()
    import mitsuba as mi

    scene = rt.load_scene(str(xml), merge_shapes=False)
    scene.frequency = 28e9
    scene.tx_array, scene.rx_array = arrays["tx_array"], arrays["rx_array"]
    ends = [(rt.Transmitter, TX, TX_RAD), *((rt.Receiver, *each) for each in zip(RX, RX_RAD, strict=True))]
    for number, (device, *place) in enumerate(ends):
        position, orientation = (mi.Point3f(*map(float, values)) for values in place)
        scene.add(device(f"end{number}", position=position, orientation=orientation))
    options = {"diffraction": diffraction, "edge_diffraction": diffraction, "synthetic_array": synthetic}
    options |= {"samples_per_src": 20_000, "max_num_paths_per_src": 200_000}
    return rt.PathSolver(deterministic=True)(scene, max_depth=depth, refraction=False, **options)


def matches(links: sp.TracedLinks, paths: Any) -> list[tuple[int, int, int]]:
    """Receiver, number among its paths, and number in stock's, of paths with the same interactions and points."""
    kinds, points_m = (np.moveaxis(part.numpy()[:, :, 0], 0, 2) for part in (paths.interactions, paths.vertices))
    valid, depth, found = paths.valid.numpy()[:, 0], links.interactions.shape[1], []
    for rx in range(len(RX)):
        for number, path in enumerate(np.flatnonzero(links.path_rx == rx)):
            same = valid[rx] & (kinds[rx][:, :depth] == links.interactions[path][: kinds.shape[2]]).all(axis=1)
            there = links.interactions[path] > 0
            apart = np.abs(points_m[rx][:, : there.sum()] - links.vertices_m[path][there]).max(axis=(1, 2), initial=0.0)
            found += [(rx, number, int(each)) for each in np.flatnonzero(same & (apart < 1e-3))[:1]]
    return found


class TestTransfer:
    def test_paths_of_rays(self) -> None:
        """Sionna RT's public solver gives the same matrices."""
        exact = links_of(1)
        settings = replace(exact.trace_settings, diffuse_reflection=True, samples_per_tx=20_000)
        shot = sp.trace_links(_room(), TX, RX, trace_settings=settings)
        found = 0
        for path in range(len(exact.a)):
            same = (shot.path_rx == exact.path_rx[path]) & (np.abs(shot.delay_s - exact.delay_s[path]) < 1e-13)
            same &= (shot.interactions == exact.interactions[path]).all(axis=1)
            if same.any():
                found += 1
                scale = 1e-3 * np.abs(exact.a[path])
                np.testing.assert_allclose(shot.transfer[same.argmax()], exact.transfer[path], atol=scale)
        assert found > 10


class TestAgainstStock:
    """Sionna RT rounds delays, and with them phases at 28 GHz, to single precision: so do we."""

    @pytest.mark.parametrize(
        ("depth", "tx", "rx", "normalize_delays"),
        [
            (1, ("iso", "VH"), ("dipole", "cross"), True),
            (3, ("tr38901", "cross"), ("complex", "VH"), False),
        ],
    )
    def test_every_response(
        self, room_xml: Path, depth: int, tx: tuple[str, str], rx: tuple[str, str], normalize_delays: bool
    ) -> None:
        arrays = {"tx_array": array_of(4, 4, *tx), "rx_array": array_of(2, 1, *rx)}
        links, paths = links_of(depth), stock_paths(room_xml, depth, arrays, synthetic=True)
        options = {**arrays, **ORIENTATIONS, "normalize_delays": normalize_delays}
        a, delay_s = paths.cir(normalize_delays=normalize_delays, out_type="numpy")
        same = matches(links, paths)
        assert len(same) == len(links.a) == (delay_s >= 0).sum()
        channels = links.cir(**options)
        scale = np.abs(a).max(axis=(1, 2, 3, 4, 5))
        for receiver, ours, theirs in same:
            found = channels.a[receiver, :, :, ours].to_numpy()
            np.testing.assert_allclose(found, a[receiver, :, 0, :, theirs, 0], atol=1e-4 * scale[receiver])
            assert channels.delay_s[receiver, ours].item() == pytest.approx(delay_s[receiver, 0, theirs], abs=1e-14)
        offsets_hz = np.linspace(-2e8, 2e8, 17)
        stock_options = {"normalize_delays": normalize_delays, "out_type": "numpy"}
        found = links.cfr(offsets_hz, **options).h, links.taps(4e8, -6, 20, **options).h
        stock = paths.cfr(offsets_hz.tolist(), **stock_options), paths.taps(4e8, -6, 20, **stock_options)
        for ours, theirs in zip(found, stock, strict=True):
            for receiver in range(3):
                expected = theirs[receiver, :, 0, :, 0]
                np.testing.assert_allclose(ours[receiver], expected, atol=1e-4 * np.abs(expected).max())

    def test_diffraction(self, room_xml: Path) -> None:
        arrays = {"tx_array": array_of(2, 2, "tr38901", "VH"), "rx_array": array_of(1, 2, "iso", "cross")}
        links = links_of(2, diffraction=True)
        paths = stock_paths(room_xml, 2, arrays, synthetic=True, diffraction=True)
        a, _ = paths.cir(normalize_delays=False, out_type="numpy")
        channels = links.cir(**arrays, **ORIENTATIONS, normalize_delays=False)
        diffracted = (links.interactions == DIFFRACTION).any(axis=1)
        errors = []
        for receiver, ours, stock in matches(links, paths):
            if diffracted[np.flatnonzero(links.path_rx == receiver)[ours]]:
                found, expected = channels.a[receiver, :, :, ours].to_numpy(), a[receiver, :, 0, :, stock, 0]
                errors.append(np.abs(found - expected).max() / np.abs(expected).max())
        assert len(errors) > 20
        assert np.max(errors) < 1e-4

    def test_per_antenna(self, room_xml: Path) -> None:
        """Stock traces between all antennas: patterns and coefficients of reflection differ between them as well."""
        arrays = {"tx_array": array_of(4, 4), "rx_array": array_of(2, 1)}
        links, paths = links_of(1), stock_paths(room_xml, 1, arrays, synthetic=False)
        expected = paths.cfr([-1e8, 1e8], normalize_delays=False, out_type="numpy")[:, :, 0, :, 0]
        options = {**arrays, **ORIENTATIONS, "normalize_delays": False}
        exact, plane = (links.cfr([-1e8, 1e8], synthetic_array=each, **options).h for each in (False, True))
        for receiver, most in enumerate((0.004, 0.004, 0.015)):
            error, of_plane = (np.abs(h[receiver] - expected[receiver]).max().item() for h in (exact, plane))
            assert error < most * np.abs(expected[receiver]).max()
            assert error < 0.5 * of_plane


class TestPerAntenna:
    """The length of a path from antenna to antenna is that of a trace between them."""

    def test_lengths(self) -> None:
        tx_array, rx_array = array_of(2, 2, spacing=6.0), array_of(2, 1, spacing=9.0)
        links = links_of(2, diffraction=True)
        options = {"tx_array": tx_array, "rx_array": rx_array, **ORIENTATIONS, "normalize_delays": False}
        exact = links.cir(synthetic_array=False, **options)
        wavelength_m = SPEED_OF_LIGHT_M_S / 28e9
        checked, kinds = 0, set()
        for receiver in range(len(RX)):
            ends = []
            for array, position_m, angles in ((tx_array, TX, TX_RAD), (rx_array, RX[receiver], RX_RAD[receiver])):
                import mitsuba as mi

                ends.append(position_m + np.array(array.rotate(wavelength_m, mi.Point3f(*map(float, angles)))).T)
            between = sp.trace_links(_room(), *ends, trace_settings=links.trace_settings)
            for number, path in enumerate(np.flatnonzero(links.path_rx == receiver)):
                there = links.interactions[path] > 0
                near = (between.interactions == links.interactions[path]).all(axis=1)
                apart = np.abs(between.vertices_m[:, there] - links.vertices_m[path][there]).max(axis=(1, 2), initial=0)
                same = np.flatnonzero(near & (apart < 0.15))
                if len({*zip(between.path_tx[same], between.path_rx[same], strict=True)}) != len(same) or len(same) < 8:
                    continue  # not seen by all, or mixed up with another
                found = exact.delay_s.to_numpy()[receiver, between.path_rx[same], between.path_tx[same], number]
                np.testing.assert_allclose(found, between.delay_s[same], atol=3e-14, rtol=0)
                checked += 1
                kinds |= {*links.interactions[path].tolist()}
        assert checked > 40
        assert kinds == {0, 1, DIFFRACTION}


@pytest.fixture(scope="module")
def several() -> sp.TracedLinks:
    """Two transmitters, three receivers; one of them is reached by no path."""
    rx = [[2.0, 1.0, 1.5], [5.0, 3.0, 1.2], [7.0, 1.0, 1.5]]
    settings = sp.TraceSettings(max_depth=2, power_tolerance_db=0.0)
    return sp.trace_links(_room(), [(1.0, 1.0, 1.5), (4.5, 1.2, 1.4)], rx, trace_settings=settings, invalid="nan")


def test_channels_have_the_paths_of_their_links() -> None:
    """Channels are sums of fields: weak paths count, which links have by request."""
    settings = [sp.TraceSettings(max_depth=2, power_tolerance_db=tolerance_db) for tolerance_db in (None, 0.0, 0.1)]
    links, every, written = (sp.trace_links(_room(), TX, RX[:2], trace_settings=each) for each in settings)
    assert sp.Simulation(_room()).with_every_path(every) is every
    completed = sp.Simulation(_room()).with_every_path(links)
    assert len(links.a) == len(written.a) < len(every.a)
    for name, arguments in (("cfr", ([-1e8, 1e8],)), ("cir", ()), ("taps", (1e8,)), ("beam_gains", ([[1.0]],))):
        found = [getattr(each, name)(*arguments) for each in (links, written, completed, every)]
        xr.testing.assert_identical(found[0], found[1])
        xr.testing.assert_identical(found[2], found[3])
        assert not found[0].equals(found[2])
        assert [each.power_tolerance_db for each in found] == [0.1, 0.1, 0.0, 0.0]


class TestResponses:
    def test_links_are_numbered_by_transmitter_and_receiver(self, several: sp.TracedLinks) -> None:
        channels = several.cir(normalize_delays=False)
        assert channels.rx_m.sel(axis="y").values.tolist() == [1.0, 3.0, 1.0] * 2
        assert channels.paths.values.reshape(2, 3)[:, 2].tolist() == [0, 0]
        power = (np.abs(channels.a) ** 2).sum(["rx_ant", "tx_ant", "path"]).values.reshape(2, 3)
        np.testing.assert_allclose(10 * np.log10(power[:, :2]), several.gain_db[:, :2], atol=1e-4)
        later = several.path_tx == 1
        found = channels.delay_s.values[3][: (several.path_rx[later] == 0).sum()]
        np.testing.assert_array_equal(found, several.delay_s[later][several.path_rx[later] == 0])
        assert np.isnan(channels.delay_s.values[2]).all()
        assert several.taps(2e8).tap.values[-1] == 6 + np.ceil(2e8 * several.cir().delay_s.max())
        assert not channels.a.values[5].any()

    def test_memory_is_asked_for_first(self, several: sp.TracedLinks) -> None:
        many = replace(several, rx=np.broadcast_to(several.rx[:1], (1_000_000, 3)))
        arrays = {"tx_array": array_of(8, 8), "rx_array": array_of(8, 8)}
        with pytest.raises(MemoryLimitError, match=r"memory_gb = 2 is too little for 2,000,000 links x 64 x 64 ant"):
            many.cir(**arrays)
        with pytest.raises(MemoryLimitError, match=r"x 8 frequencies, which take 524\.3 GB: give fewer"):
            many.cfr(np.arange(8), **arrays)
        with pytest.raises(MemoryLimitError, match=r"2,000,000 links x 4096 pairs of beams, which take 32\.9 GB"):
            many.beam_gains(np.eye(64), **arrays)

    @pytest.mark.parametrize("synthetic_array", [True, False])
    def test_blocks_change_nothing(
        self, several: sp.TracedLinks, monkeypatch: pytest.MonkeyPatch, synthetic_array: bool
    ) -> None:
        arrays = {"tx_array": array_of(2, 2), "rx_array": array_of(1, 2, "dipole", "VH")}
        options = {**arrays, "synthetic_array": synthetic_array}
        calls = (
            lambda: several.cir(**options).a,
            lambda: several.cfr(np.arange(7) * 1e6, **options).h,
            lambda: several.taps(1e8, -2, 9, **options).h,
            lambda: several.beam_gains(np.eye(4), **arrays).gain_db,
        )
        whole = [call().to_numpy() for call in calls]
        monkeypatch.setattr(array_paths, "BLOCK_BYTES", 16 * 16 * 5)
        monkeypatch.setattr(responses, "WORK_BYTES", 1)
        for before, call in zip(whole, calls, strict=True):
            np.testing.assert_allclose(call().to_numpy(), before, rtol=1e-5, atol=1e-12)

    def test_memory_stays_within_the_limit(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Many taps, frequencies and pairs of antennas; blocks of a quarter of their size need no 0.05 GB."""
        for module, name in ((array_paths, "BLOCK_BYTES"), (responses, "WORK_BYTES")):
            monkeypatch.setattr(module, name, getattr(module, name) // 4)
        links, antennas = links_of(2), {"tx_array": array_of(16, 16), "rx_array": array_of(8, 16)}
        calls = (
            lambda: links.taps(1e8, 0, 125_000, memory_gb=0.05),
            lambda: links.cfr(np.linspace(0.0, 1e6, 125_000), memory_gb=0.05),
            lambda: links.cfr([0.0], **antennas, memory_gb=0.05),
            lambda: links.beam_gains(np.eye(256), np.eye(128), **antennas, memory_gb=0.05),
        )
        tracemalloc.start()
        try:
            for call in calls:
                tracemalloc.reset_peak()
                before = tracemalloc.get_traced_memory()[0]
                call()
                assert tracemalloc.get_traced_memory()[1] - before < 0.05e9
        finally:
            tracemalloc.stop()

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (lambda links: links.cir(tx_array="8x8"), "tx_array = '8x8' is not allowed: give a sionna.rt.PlanarArray"),
            (lambda links: links.cir(tx_orientation_rad=(0, np.nan, 0)), "tx_orientation_rad = .* give three angles"),
            (lambda links: links.cfr([28e9]), "frequencies_hz = .* below the carrier of 2.8e.10 Hz"),
            (lambda links: links.taps(1e6, 5, 4), r"l_max = 4 is not allowed: give a whole number in \[5"),
            (lambda links: links.beam_gains(np.ones((2, 3))), r"codebook = .*\(2, 3\).* give \(beams, 1\) weights"),
            (
                lambda links: dft_codebook(80, 80),
                r"rows, columns = \(80, 80\) is not allowed: give 4096 antennas",
            ),
            (lambda links: replace(links, transfer=links.transfer[:, :1, :1]).cir(), "transfer = .* one polarisation"),
        ],
    )
    def test_refused(self, several: sp.TracedLinks, call: Callable[[Any], object], message: str) -> None:
        with pytest.raises(SettingsError, match=message):
            call(several)


class TestBeams:
    def test_gain_is_that_of_all_antennas(self, several: sp.TracedLinks) -> None:
        arrays = {"tx_array": array_of(4, 2, "tr38901", "VH"), "rx_array": array_of(1, 2, "dipole", "VH")}
        options = {**arrays, "tx_orientation_rad": (0.3, 0.1, 0.0), "rx_orientation_rad": np.ones((3, 3))}
        rng, at_tx = np.random.default_rng(0), dft_codebook(4, 2, 2)
        at_rx = rng.normal(size=(3, 4)) + 1j * rng.normal(size=(3, 4))
        beams = several.beam_gains(at_tx, at_rx, **options)
        a = several.cir(**options).a.values
        power = (np.abs(np.einsum("br,lrtp,ct->lbcp", at_rx.conj(), a, at_tx)) ** 2).sum(axis=-1)
        np.testing.assert_allclose(beams.gain_db, 10 * np.log10(power.clip(1e-15)), atol=1e-3)
        flat = np.sort(power.reshape(6, -1), axis=1)
        np.testing.assert_allclose(beams.margin_db[:2], 10 * np.log10(flat[:2, -1] / flat[:2, -2]), atol=1e-3)
        best = power.reshape(6, -1).argmax(axis=1)
        linked, found = [0, 1, 3, 4], beams.best_rx_beam * len(at_tx) + beams.best_tx_beam
        assert found[linked].values.tolist() == best[linked].tolist()
        assert beams.best_tx_beam[[2, 5]].values.tolist() == [-1, -1]
        assert np.isnan(beams.margin_db[[2, 5]]).all()

    def test_codebook_is_orthonormal_and_points(self) -> None:
        beams = dft_codebook(4, 8, 2)
        np.testing.assert_allclose(beams @ beams.conj().T, np.eye(64), atol=1e-12)
        field = sp.PartialMap(np.zeros((60, 60), dtype=np.uint8), 0.1)
        y = 4.0 * np.tan(np.arcsin(2 * np.arange(4) / 8))  # sin(azimuth) = 2 k / columns: the k-th beam across
        rx = np.column_stack([np.full(4, 5.0), 1.0 + y, np.full(4, 1.5)])[:3]
        links = sp.trace_links(field, (1.0, 1.0, 1.5), rx, scene_settings=sp.SceneSettings(floor_extent="none"))
        found = links.beam_gains(dft_codebook(4, 8), tx_array=array_of(4, 8))
        assert found.best_tx_beam.values.tolist() == [0, 4, 8]
        gain_db = found.gain_db.max(["rx_beam", "tx_beam"]).values - links.gain_db
        np.testing.assert_allclose(gain_db, 10 * np.log10(32), atol=1e-2)


def one_link(*paths: tuple[float, float, float, int]) -> sp.TracedLinks:
    """One link with paths (power, delay [ns], azimuth of departure [rad], interaction)."""
    power, delay_ns, azimuth, kind = np.array(paths, dtype=float).reshape(-1, 4).T
    count = len(power)
    transfer = np.zeros((count, 2, 2), complex)
    transfer[:, 0, 0] = np.sqrt(power)
    return made_links(
        np.zeros(3),
        np.ones((1, 3)),
        link_state=np.ones(1, np.uint8),
        gain_db=10 * np.log10(np.maximum([power.sum()], 1e-15)),
        transfer=transfer,
        delay_s=1e-9 * delay_ns,
        departure_rad=np.stack([np.full(count, np.pi / 2), azimuth], axis=1),
        arrival_rad=np.stack([azimuth / 2, np.full(count, 3.0)], axis=1),
        interactions=kind.astype(np.uint8)[:, None],
    )


class TestSpreads:
    """Cases by hand, with the definitions of TR 38.901."""

    def test_spreads(self) -> None:
        found = one_link((3e-8, 10.0, np.pi - 0.1, 0), (1e-8, 50.0, 0.1 - np.pi, 1)).spreads()
        assert found.delay_spread_s.values == pytest.approx([40e-9 * np.sqrt(0.75 * 0.25)])
        assert found.k_factor_db.values == pytest.approx([10 * np.log10(3.0)])
        assert found.path_loss_db.values == pytest.approx([-10 * np.log10(4e-8)])
        length = np.hypot(np.cos(0.1), 0.5 * np.sin(0.1))  # across the end of the range of azimuth
        assert found.azimuth_departure_spread_rad.values == pytest.approx([np.sqrt(-2 * np.log(length))])
        assert found.zenith_departure_spread_rad.values == pytest.approx([0.0], abs=1e-7)
        assert found.azimuth_arrival_spread_rad.values == pytest.approx([0.0], abs=1e-7)
        alone = one_link((1e-8, 10.0, 0.3, 0)).spreads()
        assert alone.k_factor_db.values.tolist() == [np.inf]
        assert alone.delay_spread_s.values.tolist() == [0.0]
        assert np.isnan(one_link((1e-8, 10.0, 0.3, 1)).spreads().k_factor_db).all()
        assert np.isnan(one_link().spreads().to_array()).all()


class TestFiles:
    @pytest.fixture
    def options(self) -> dict[str, Any]:
        return {"tx_array": array_of(2, 2, "iso", "VH"), "rx_array": array_of(1, 2)}

    @pytest.mark.parametrize(("suffix", "synthetic_array"), [(".nc", False), (".h5", True), (".zarr", True)])
    def test_links_as_sionna_has_them(
        self, several: sp.TracedLinks, tmp_path: Path, options: dict[str, Any], suffix: str, synthetic_array: bool
    ) -> None:
        options["synthetic_array"] = synthetic_array
        whole, path = several.cir(**options), tmp_path / f"channels{suffix}"
        save_channels(several, path, **options)
        found = load_channels(path)
        assert found.a.dims == ("rx", "rx_ant", "tx", "tx_ant", "path", "time")
        assert found.a.dtype == np.complex64
        assert found.a.shape == (3, 2, 2, 8, whole.sizes["path"], 1)
        assert found.tau.dims == (("rx", "tx", "path") if synthetic_array else found.a.dims[:-1])
        for tx, rx in np.ndindex(2, 3):
            link = whole.isel(link=3 * tx + rx)
            np.testing.assert_array_equal(found.a[rx, :, tx, ..., 0], link.a)
            np.testing.assert_array_equal(found.tau.isel(rx=rx, tx=tx), link.delay_s.fillna(-1.0))
        np.testing.assert_array_equal(found.rx_m, several.rx)
        assert [each.name for each in tmp_path.iterdir()] == [path.name]

    def test_computed_channels(self, several: sp.TracedLinks, tmp_path: Path, options: dict[str, Any]) -> None:
        channels, response = several.cir(**options), several.cfr([0.0, 1e6], **options)
        save_channels(channels.isel(link=[5, 3, 4]).transpose("path", ...), tmp_path / "some.nc")
        save_channels(several, tmp_path / "links.nc", **options)
        found, every = (load_channels(tmp_path / name) for name in ("some.nc", "links.nc"))
        xr.testing.assert_equal(found, every.isel(tx=[1]))
        save_channels(response, tmp_path / "h.nc")
        found = load_channels(tmp_path / "h.nc")
        assert found.h.dims == ("rx", "rx_ant", "tx", "tx_ant", "time", "frequency")
        np.testing.assert_array_equal(found.h[1, :, 1, :, 0], response.h[4])
        assert found.frequency.values.tolist() == [0.0, 1e6]

    def test_as_deepmimo_has_them(self, tmp_path: Path) -> None:
        links = links_of(1)
        save_channels(links, tmp_path / "one.h5", layout="deepmimo", tx_array=array_of(2, 2))
        found, whole = load_channels(tmp_path / "one.h5"), links.cir(tx_array=array_of(2, 2))
        assert found.channel.dims == ("rx", "rx_ant", "tx_ant", "path")
        assert found.channel.sizes["path"] == whole.a.sizes["path"] > 1
        np.testing.assert_array_equal(found.delay, whole.delay_s)
        save_channels(links.cfr([0.0, 1e6]), tmp_path / "h.h5", layout="deepmimo")
        assert load_channels(tmp_path / "h.h5").channel.dims == ("rx", "rx_ant", "tx_ant", "frequency")

    @pytest.mark.parametrize("polarization", ["V", "VH"])
    def test_antennas_in_the_order_of_deepmimo(self, polarization: str, tmp_path: Path) -> None:
        """Antenna m of a panel of H x V has the indices (0, m mod H, m div H): its phase is pi times their advance."""
        (vertical, horizontal), links = (2, 4), links_of(1)
        options = {"tx_array": array_of(vertical, horizontal, polarization=polarization), "normalize_delays": False}
        save_channels(links, tmp_path / "direct.h5", layout="deepmimo", **options)
        save_channels(links.cir(**options), tmp_path / "computed.h5", layout="deepmimo")
        found, again = (load_channels(tmp_path / name) for name in ("direct.h5", "computed.h5"))
        np.testing.assert_array_equal(found.channel, again.channel)
        number = np.arange(vertical * horizontal)
        indices = np.stack([0 * number, number % horizontal, number // horizontal], axis=1)
        zenith, azimuth = links.departure_rad[links.path_rx == 0].T
        toward = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
        channel = found.channel[0, 0, : len(number), : toward.shape[1]].to_numpy()
        expected = np.exp(1j * np.pi * indices @ toward)
        np.testing.assert_allclose(channel / channel[0], expected / expected[0], atol=1e-4)

    def test_blocks_equal_bytes_and_progress(
        self, several: sp.TracedLinks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fractions: list[float] = []
        save_channels(several, tmp_path / "whole.nc")
        with h5py.File(tmp_path / "whole.nc") as file:  # HDF5 would write seconds down
            assert not file["a"].id.get_create_plist().get_obj_track_times()
        monkeypatch.setattr("sionna_partial.channels.files.CHUNK_BYTES", 1)
        save_channels(several, tmp_path / "parts.nc", progress=lambda fraction, _: fractions.append(fraction))
        xr.testing.assert_equal(load_channels(tmp_path / "whole.nc"), load_channels(tmp_path / "parts.nc"))
        assert fractions[-1] == 1.0
        assert len({*fractions}) == 7
        save_channels(several, tmp_path / "again.nc")
        assert (tmp_path / "again.nc").read_bytes() == (tmp_path / "parts.nc").read_bytes()

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (
                lambda path, links: save_channels(links, path, layout="matlab"),
                "layout = 'matlab' is not allowed",
            ),  # type: ignore[arg-type]
            (
                lambda path, links: save_channels(links, path, layout="deepmimo"),
                "transmitters = 2 is not allowed",
            ),
            (
                lambda path, links: save_channels(xr.Dataset(), path),
                "channels.tx = 'missing' .* or what their cir",
            ),
            (
                lambda path, links: save_channels(links.cfr([0])[{"frequency": 0}], path),
                "channels.h = .*give links",
            ),
            (
                lambda path, links: save_channels(one_link(), path),
                "channels = '1 links' .* none has a path",
            ),
            (
                lambda path, links: save_channels(links, path.parent / "x.zarr"),
                "is there already: remove it, or",
            ),
            (
                lambda path, links: load_channels(path.with_name("other.nc")),
                "it holds no channels; give a file of",
            ),
        ],
    )
    def test_refused(self, several: sp.TracedLinks, tmp_path: Path, call: Callable[..., object], message: str) -> None:
        xr.Dataset({"x": 1.0}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
        (tmp_path / "x.zarr").mkdir()
        with pytest.raises((SettingsError, OutputError), match=message):
            call(tmp_path / "channels.nc", several)
        assert {each.name for each in tmp_path.rglob("*")} == {"other.nc", "x.zarr"}
