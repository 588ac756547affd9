"""Channel responses: against stock Sionna RT on the same paths, and against traces from antenna to antenna."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_trace import _room

import sionna_partial as sp
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.scene.scene import export_scene
from sionna_partial.tracing.engine import load_sionna
from sionna_partial.tracing.paths import DIFFRACTION

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


def links_of(depth: int, *, diffraction: bool = False, frequency_hz: float = 28e9) -> sp.TracedLinks:
    settings = sp.TraceSettings(frequency_hz, depth, power_tolerance_db=0.0, diffraction=diffraction, open_ends=True)
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

    def at(values: Any) -> Any:
        return mi.Point3f(*map(float, values))

    scene.add(rt.Transmitter("tx", position=at(TX), orientation=at(TX_RAD)))
    for number, each in enumerate(zip(RX, RX_RAD, strict=True)):
        scene.add(rt.Receiver(f"rx{number}", position=at(each[0]), orientation=at(each[1])))
    return rt.PathSolver(deterministic=True)(
        scene,
        max_depth=depth,
        refraction=False,
        diffraction=diffraction,
        edge_diffraction=diffraction,
        synthetic_array=synthetic,
        samples_per_src=100_000,
        max_num_paths_per_src=1_000_000,
    )


def matches(links: sp.TracedLinks, paths: Any) -> list[tuple[int, int, int]]:
    """Receiver, number among its paths, and number in stock's, of paths with the same interactions and points."""
    depth = links.interactions.shape[1]
    kinds = np.moveaxis(paths.interactions.numpy()[:, :, 0], 0, 2)
    points_m = np.moveaxis(paths.vertices.numpy()[:, :, 0], 0, 2)
    valid, found = paths.valid.numpy()[:, 0], []
    for rx in range(len(RX)):
        ours = np.flatnonzero(links.path_rx == rx)
        for number, path in enumerate(ours):
            same = valid[rx] & (kinds[rx][:, :depth] == links.interactions[path][: kinds.shape[2]]).all(axis=1)
            there = links.interactions[path] > 0
            apart = np.abs(points_m[rx][:, : there.sum()] - links.vertices_m[path][there]).max(axis=(1, 2), initial=0.0)
            found += [(rx, number, int(each)) for each in np.flatnonzero(same & (apart < 1e-3))[:1]]
    return found


CASES = [
    (0, ("iso", "V"), ("iso", "V")),
    (1, ("iso", "VH"), ("dipole", "cross")),
    (2, ("tr38901", "VH"), ("hw_dipole", "V")),
    (3, ("tr38901", "cross"), ("complex", "VH")),
]


class TestAgainstStock:
    """Sionna RT rounds delays, and with them phases at 28 GHz, to single precision: so do we."""

    @pytest.mark.parametrize("normalize_delays", [True, False])
    @pytest.mark.parametrize(("depth", "tx", "rx"), CASES)
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
        a, _ = paths.cir(out_type="numpy")
        channels = links.cir(**arrays, **ORIENTATIONS)
        diffracted = (links.interactions == DIFFRACTION).any(axis=1)
        errors = []
        for receiver, ours, stock in matches(links, paths):
            if diffracted[np.flatnonzero(links.path_rx == receiver)[ours]]:
                found, expected = channels.a[receiver, :, :, ours].to_numpy(), a[receiver, :, 0, :, stock, 0]
                errors.append(np.abs(np.abs(found) - np.abs(expected)).max() / np.abs(expected).max())
        assert len(errors) > 20
        print(sorted(errors)[-5:], len(errors))
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
            assert error < 0.1 * of_plane


class TestPerAntenna:
    """The length of a path from antenna to antenna is that of a trace between them."""

    @pytest.mark.parametrize("depth", [0, 3])
    def test_lengths(self, depth: int) -> None:
        tx_array, rx_array = array_of(2, 2, spacing=6.0), array_of(2, 1, spacing=9.0)
        links = links_of(depth, diffraction=depth > 0)
        options = {"tx_array": tx_array, "rx_array": rx_array, **ORIENTATIONS, "normalize_delays": False}
        exact = links.cir(synthetic_array=False, **options)
        wavelength_m = SPEED_OF_LIGHT_M_S / 28e9
        checked, kinds = 0, set()
        for receiver in range(len(RX)):
            ends = []
            for array, position_m, angles in (
                (tx_array, TX, TX_RAD),
                (rx_array, RX[receiver], RX_RAD[receiver]),
            ):
                import mitsuba as mi

                ends.append(position_m + np.array(array.rotate(wavelength_m, mi.Point3f(*map(float, angles)))).T)
            between = sp.trace_links(_room(), *ends, trace_settings=links.settings)
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
        assert checked > (2 if depth == 0 else 40)
        assert kinds == ({0} if depth == 0 else {0, 1, DIFFRACTION})
