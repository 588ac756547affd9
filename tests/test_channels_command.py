"""The command channels: what it writes, and how it fails."""

from pathlib import Path

import numpy as np
import pytest
from commands import run
from test_trace import _room

import sionna_partial as sp

pytestmark = pytest.mark.usefixtures("command_line")


@pytest.fixture
def map_path(tmp_path: Path) -> Path:
    sp.save_map(_room(), tmp_path / "map.yaml")
    return tmp_path / "map.yaml"


def test_receivers_of_a_file(map_path: Path, tmp_path: Path) -> None:
    (tmp_path / "rx.csv").write_text("name, x, y, z\na, 2.0, 1.0, 1.5\nb, 5.0, 3.0, 1.2\n\n")
    arrays = ["--array", "2x4", "--rx-array", "2x1", "--polarization", "VH", "--pattern", "tr38901"]
    out = tmp_path / "out" / "channels.h5"
    options = ["--orientation", -0.5, 0.1, 0, "--max-depth", 1, "--frequency", 5e9, "--no-diffraction"]
    result = run("channels", map_path, "--tx", 1, 1, 1.4, "--rx", tmp_path / "rx.csv", "--out", out, *arrays, *options)
    found = sp.channels.load_channels(out)
    assert found.a.shape[:4] == (2, 4, 1, 16)
    assert found.rx_m.values.tolist() == [[2.0, 1.0, 1.5], [5.0, 3.0, 1.2]]
    assert result.stdout.splitlines() == [f"2 receivers, {found.paths.sum().item()} paths", f"wrote {out}"]
    settings = sp.TraceSettings(5e9, 1, diffraction=False, power_tolerance_db=0.0)
    links = sp.trace_links(_room(), (1.0, 1.0, 1.4), found.rx_m.values, trace_settings=settings)
    from sionna.rt import PlanarArray

    tx_array, rx_array = (
        PlanarArray(num_rows=rows, num_cols=columns, pattern=pattern, polarization="VH")
        for rows, columns, pattern in ((2, 4, "tr38901"), (2, 1, "iso"))
    )
    expected = links.cir(tx_array=tx_array, rx_array=rx_array, tx_orientation_rad=(-0.5, 0.1, 0.0))
    np.testing.assert_array_equal(found.a[:, :, 0, :, :, 0], expected.a)
    assert found.power_tolerance_db == expected.power_tolerance_db == 0.0


def test_grid(map_path: Path, tmp_path: Path) -> None:
    out = tmp_path / "channels.zarr"
    options = ("--spacing", 0.8, "--max-depth", 0, "--layout", "deepmimo")
    run("channels", map_path, "--tx", 1, 1, "--out", out, *options)
    found = sp.channels.load_channels(out)
    assert found.channel.dims == ("rx", "rx_ant", "tx_ant", "path")
    assert (_room().state_at(found.rx_m.values) == sp.CellState.FREE).all()
    assert 20 < found.sizes["rx"] < 45


def test_refused(map_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.csv").write_text("a,b\n1,2\n")
    Path("cut.csv").write_text("x,y,z\n1,2,1\n3,4\n")
    Path("wall.csv").write_text("rx_x,rx_y,rx_z\n3.05,0.5,1.5\n")
    for option, value, message in (
        ("--array", "8", "--array '8' is no array: give rows and columns, such as 8x8."),
        ("--spacing", "0", "spacing_m = 0.0 is not allowed: give a number in [0.01, 1e+06]."),
        ("--rx", "none.csv", "--rx = 'none.csv' cannot be read"),
        ("--rx", "bad.csv", "bad.csv' has no positions: give a CSV with the columns x,y,z in metres."),
        ("--rx", "cut.csv", "cut.csv', line 3: z = '' is not a number: correct the line"),
        ("--rx", "wall.csv", "rx[0] ="),
    ):
        result = run("channels", map_path, "--tx", 1, 1, "--out", tmp_path / "channels.nc", option, value, exit_code=2)
        assert message in " ".join(result.output.replace("│", " ").split())
        assert not (tmp_path / "channels.nc").exists()
