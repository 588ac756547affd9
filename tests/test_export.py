import h5netcdf
import numpy as np
import pandas as pd
import pytest
import rasterio
import xarray as xr
import yaml
from coverage_cases import PICTURE, SEVERAL, map_of
from PIL import Image
from typer.testing import CliRunner

from sionna_partial import cli
from sionna_partial.constants import CellState
from sionna_partial.coverage.network import predict_network
from sionna_partial.errors import MapError, OutputError, SettingsError
from sionna_partial.export import TABLE_VARIABLES, save_coverage, save_network
from sionna_partial.maps.map_files import load_map, save_map

SUFFIXES = (".nc", ".tif", ".csv", ".png", ".html", ".yaml")


def test_netcdf_returns_an_equal_dataset_with_or_without_xarray(coverage, tmp_path):
    save_coverage(coverage, tmp_path / "coverage.nc")
    loaded = xr.load_dataset(tmp_path / "coverage.nc")
    xr.testing.assert_identical(loaded, coverage)
    assert "_FillValue" not in loaded["x"].encoding
    save_coverage(loaded, tmp_path / "again.nc")
    assert (tmp_path / "again.nc").read_bytes() == (tmp_path / "coverage.nc").read_bytes()
    with h5netcdf.File(tmp_path / "coverage.nc") as file:
        assert file.attrs["Conventions"] == "CF-1.11"
        assert file["gain_mean_db"].attrs["units"] == "dB"
        assert file["gain_mean_db"].dimensions == ("y", "x")


def test_geotiff_has_the_values_of_the_dataset_and_their_units_and_settings(coverage, tmp_path):
    coverage["distance_m"][3, 4] = 255.0
    save_coverage(coverage, tmp_path / "coverage.tif")
    with rasterio.open(tmp_path / "coverage.tif") as image:
        assert image.descriptions == TABLE_VARIABLES
        assert image.crs is None
        assert tuple(image.bounds) == pytest.approx((-1.0, 2.0, 5.0, 6.0))
        assert np.isnan(image.nodata)
        assert image.units[TABLE_VARIABLES.index("gain_mean_db")] == "dB"
        assert image.tags()["units"] == "m"
        assert image.tags()["predictor"] == "map"
        assert image.tags(1 + TABLE_VARIABLES.index("link_state"))["flag_meanings"] == "outage los nlos no_receiver"
        for name, layer in zip(TABLE_VARIABLES, image.read(), strict=True):
            np.testing.assert_allclose(np.flipud(layer), table_values(coverage, name), rtol=1e-6, err_msg=name)


def table_values(coverage, name):
    values = coverage[name].to_numpy().astype(np.float64)
    return np.where(coverage["valid"], values, np.nan) if name.endswith("link_state") else values


def test_csv_has_a_row_for_each_receiver(coverage, tmp_path):
    save_coverage(coverage, tmp_path / "coverage.csv")
    table = pd.read_csv(tmp_path / "coverage.csv")
    assert list(table.columns) == ["x_m", "y_m", *TABLE_VARIABLES]
    assert len(table) == coverage["valid"].size
    np.testing.assert_allclose(table["y_m"], np.repeat(coverage["y"], coverage.sizes["x"]))
    for name in TABLE_VARIABLES:
        np.testing.assert_allclose(table[name], table_values(coverage, name).ravel(), rtol=1e-6, err_msg=name)
    save_coverage(coverage.assign_coords(x=coverage["x"] + 500_000.0), tmp_path / "coverage.csv")
    assert pd.read_csv(tmp_path / "coverage.csv")["x_m"][0] == 499_999.125


def occupancy_of(path):
    """As nav2_map_server reads it in raw mode: shades 0 to 98 are occupancies, others unknown, row 0 is the top."""
    sheet = yaml.safe_load(path.read_text())
    assert (sheet["mode"], sheet["negate"], sheet["image"]) == ("raw", 0, f"{path.stem}.pgm")
    shades = np.flipud(np.asarray(Image.open(path.with_suffix(".pgm")))).astype(int)
    return sheet, np.where(shades <= 100, shades, -1)


def test_costs_are_on_the_cells_of_the_map_and_below_the_threshold(coverage, tmp_path):
    scene = map_of(PICTURE)
    save_coverage(coverage, tmp_path / "cost.yaml", scene=scene, threshold_db=-62.0)
    sheet, cost = occupancy_of(tmp_path / "cost.yaml")
    assert (cost.shape, sheet["resolution"], sheet["origin"]) == (scene.shape, 0.5, [-1.0, 2.0, 0.0])
    assert ((cost >= 0) == (scene.state == CellState.FREE)).all()
    p_below = 1.0 - coverage.radio.probability_above(-62.0)
    for row, column in np.argwhere(scene.state == CellState.FREE):
        x, y = -1.0 + 0.5 * (column + 0.5), 2.0 + 0.5 * (row + 0.5)  # in the middle of four receivers
        near = np.minimum(100 * p_below.sel(x=slice(x - 0.2, x + 0.2), y=slice(y - 0.2, y + 0.2)), 98)
        assert np.isnan(near).any() or np.abs(near - cost[row, column]).min() < 0.51
    assert cost.max() == 98
    assert 0 <= cost[cost >= 0].min() < 20
    save_coverage(coverage, tmp_path / "all.yaml", scene=scene, threshold_db=-150.0)
    assert occupancy_of(tmp_path / "all.yaml")[1].max() <= round(100 * float(coverage["p_outage"].max()))
    with pytest.raises(MapError, match="scene is of type str: give a PartialMap"):
        save_coverage(coverage, tmp_path / "cost.yaml", scene="map.yaml")


def test_without_a_map_costs_are_on_the_receivers(coverage, tmp_path):
    save_coverage(coverage, tmp_path / "cost.yaml")
    sheet, cost = occupancy_of(tmp_path / "cost.yaml")
    assert (cost.shape, sheet["resolution"]) == (coverage["valid"].shape, 0.25)
    assert ((cost >= 0) == (coverage["cell_state"] == CellState.FREE).to_numpy()).all()
    loaded = load_map(tmp_path / "cost.yaml")
    assert (loaded.state[cost > 66] == CellState.WALL).all()
    assert (loaded.state[cost < 0] == CellState.UNKNOWN).all()


def test_equal_maps_give_equal_files(coverage, tmp_path):
    files = []
    for folder in (tmp_path / "first", tmp_path / "second"):
        for suffix in SUFFIXES:  # those after .nc take longer than the whole seconds of HDF5's time stamps
            save_coverage(coverage.copy(deep=True), folder / f"coverage{suffix}")
        files.append({file.name: file.read_bytes() for file in folder.iterdir()})
    assert files[0] == files[1]
    assert len(files[0]) == len(SUFFIXES) + 1


class TestSeveralTransmitters:
    def test_csv_has_the_transmitter_first(self, several, tmp_path):
        save_coverage(several, tmp_path / "coverage.csv")
        table = pd.read_csv(tmp_path / "coverage.csv")
        assert list(table.columns) == ["tx", "x_m", "y_m", *TABLE_VARIABLES]
        for name, rows in table.groupby("tx"):
            save_coverage(several.sel(tx=name), tmp_path / "one.csv")
            alone = pd.read_csv(tmp_path / "one.csv")
            pd.testing.assert_frame_equal(rows.drop(columns="tx").reset_index(drop=True), alone)
        assert set(table["tx"]) == {*SEVERAL}

    def test_geotiff_has_a_band_for_each_variable_and_transmitter(self, several, tmp_path):
        save_coverage(several, tmp_path / "coverage.tif")
        with rasterio.open(tmp_path / "coverage.tif") as image:
            names = image.descriptions
            assert [name for name in names if ":" not in name] == ["observed", "cell_state"]
            for tx in SEVERAL:
                band = 1 + names.index(f"{tx}:gain_mean_db")
                np.testing.assert_array_equal(np.flipud(image.read(band)), several["gain_mean_db"].sel(tx=tx))
                assert image.tags(band)["transmitter_m"] == str([*SEVERAL[tx], 1.5])
                assert image.units[band - 1] == "dB"

    @pytest.mark.usefixtures("command_line")
    def test_the_command_network_writes_the_page(self, tmp_path):
        save_map(map_of(PICTURE), tmp_path / "map.yaml")
        options = [word for x, y in SEVERAL.values() for word in ("--tx", x, y)]
        options += ["--tx-power", 23, "--tx-power", 20, "--channel", 1, "--channel", 6]
        words = ["network", tmp_path / "map.yaml", *options, "--spacing", 0.5, "--out", tmp_path / "out"]
        result = CliRunner().invoke(cli.app, [*map(str, words)])
        assert result.exit_code == 0, result.output
        files = ["coverage.nc", "coverage.html", "network.nc", "network.png"]
        written = [f"wrote {tmp_path / 'out' / name}" for name in files]
        assert result.stdout.splitlines() == ["tx1: channel 1, tx2: channel 6", *written]
        assert sorted(file.name for file in (tmp_path / "out").iterdir()) == sorted(files)
        assert xr.load_dataset(tmp_path / "out" / "network.nc").attrs["tx_power_dbm"].tolist() == [23.0, 20.0]

    def test_the_ros_map_of_a_network_holds_the_outage_of_all(self, several, tmp_path):
        network = predict_network(several, n=50)
        save_network(network, tmp_path / "outage.yaml", scene=map_of(PICTURE))
        _, cost = occupancy_of(tmp_path / "outage.yaml")
        assert ((cost >= 0) == (map_of(PICTURE).state == CellState.FREE)).all()
        outage = network.assign(p_all_outage=network["p_all_outage"] * 0.0 + 0.4)
        save_network(outage, tmp_path / "some.yaml", scene=map_of(PICTURE))
        assert set(np.unique(occupancy_of(tmp_path / "some.yaml")[1])) == {-1, 40}

    def test_costs_of_several_are_the_smallest(self, several, tmp_path):
        thresholds_db = [-62.0, -80.0]
        save_coverage(several, tmp_path / "all.yaml", scene=map_of(PICTURE), threshold_db=thresholds_db)
        each = []
        for at, threshold_db in enumerate(thresholds_db):
            save_coverage(several.isel(tx=at), tmp_path / "one.yaml", scene=map_of(PICTURE), threshold_db=threshold_db)
            each.append(occupancy_of(tmp_path / "one.yaml")[1])
        np.testing.assert_array_equal(occupancy_of(tmp_path / "all.yaml")[1], np.min(each, axis=0))
        with pytest.raises(SettingsError, match=r"coverage\.tx = \['west', 'west'\] is not allowed: give each a name"):
            save_coverage(several.isel(tx=[0, 0]), tmp_path / "twice.yaml")


@pytest.mark.parametrize("name", ["coverage.nc.gz"])
def test_an_unknown_suffix_is_named(coverage, tmp_path, name):
    with pytest.raises(OutputError, match=r"path = '.*coverage.*' has the suffix '.*': choose one of \.nc, \.tif"):
        save_coverage(coverage, tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".nc", ".yaml"])
def test_a_full_disk_leaves_the_old_files(coverage, tmp_path, files_that_fit, suffix):
    names = [f"coverage{suffix}"] + ["coverage.pgm"] * (suffix == ".yaml")
    for name in names:
        (tmp_path / name).write_text("old")
    (tmp_path / "folder" / f"coverage{suffix}").mkdir(parents=True)
    with pytest.raises(OutputError, match=f"coverage{suffix}"):
        save_coverage(coverage, tmp_path / "folder" / f"coverage{suffix}")
    files_that_fit(0)
    with pytest.raises(OutputError, match=r"No space left.*disk is full"):
        save_coverage(coverage, tmp_path / f"coverage{suffix}")
    assert sorted(file.name for file in tmp_path.iterdir() if file.is_file()) == sorted(names)
    assert all((tmp_path / name).read_text() == "old" for name in names)
