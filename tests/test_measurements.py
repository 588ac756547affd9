"""Measurements: every form gives the same arrays, and what is unusable is named."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.errors import MeasurementError
from sionna_partial.measurements.measurements import Measurements, measurements_of, merged, nearest_transmitters

TX = np.array([[1.0, 2.0, 1.5], [1.0, 2.0, 1.5], [3.0, 4.0, 2.0]])
RX = np.array([[2.0, 2.0, 1.5], [4.0, 1.0, 1.5], [5.0, 5.0, 1.0]])
GAIN_DB = np.array([-70.5, -140.0, -99.25])
FIELDS = {"tx": TX, "rx": RX, "gain_db": GAIN_DB}
FLAT = {f"{end}_{axis}": FIELDS[end][:, k] for end in ("tx", "rx") for k, axis in enumerate("xyz")} | {
    "gain_db": GAIN_DB
}
HEADER = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,gain_db"


class Frame:
    """Behaves as a pandas data frame does: a column of triples is an array of objects."""

    def __init__(self, columns: dict[str, list[object]]) -> None:
        self.columns = columns

    def __getitem__(self, name: str) -> NDArray[np.object_]:
        column = np.empty(len(self.columns[name]), dtype=object)
        column[:] = self.columns[name]
        return column


def csv_file(folder: Path, text: str) -> Path:
    path = folder / "measured.csv"
    path.write_text(text, encoding="utf-8")
    return path


class TestForms:
    @pytest.mark.parametrize(
        "source",
        [
            Measurements(TX, RX, GAIN_DB),
            FIELDS,
            Frame({"tx": [*map(tuple, TX)], "rx": [*RX], "gain_db": [*GAIN_DB]}),
            Frame({name: [*values] for name, values in FLAT.items()}),
            xr.Dataset({"tx": (("link", "axis"), TX), "rx": (("link", "axis"), RX), "gain_db": ("link", GAIN_DB)}),
        ],
    )
    def test_all_give_the_same(self, source: object) -> None:
        found = measurements_of(source)
        for name, values in FIELDS.items():
            assert getattr(found, name).dtype == np.float64
            np.testing.assert_array_equal(getattr(found, name), values)

    def test_csv_of_a_spreadsheet(self, tmp_path: Path) -> None:
        """With a byte order mark, blanks, other columns, another order, and no heights."""
        path = csv_file(tmp_path, "\ufeffnote, gain_db, rx_y, rx_x, tx_x, tx_y\nhall, -80, 2, 1, 3, 4\n")
        found = measurements_of(path)
        assert (found.tx.tolist(), found.rx.tolist(), found.gain_db.tolist()) == ([[3, 4, 1.5]], [[1, 2, 1.5]], [-80])

    def test_one_transmitter_and_copies(self) -> None:
        gain_db = GAIN_DB.copy()
        found = measurements_of({"tx": TX[0], "rx": RX, "gain_db": gain_db})
        gain_db[0] = -1.0
        assert found.gain_db[0] == GAIN_DB[0]
        np.testing.assert_array_equal(found.tx, [TX[0]] * 3)


def test_repetitions_are_averaged() -> None:
    rows = np.array([2, 0, 1, 0, 2, 2])
    moved = RX[rows] + np.linspace(-0.002, 0.002, 6)[:, None]
    noise_db = np.array([0.0, 1.0, 0.0, -1.0, 3.0, -3.0])
    links, link, variance = merged(Measurements(TX[rows], moved, GAIN_DB[rows] + noise_db))
    assert link.tolist() == [0, 1, 2, 1, 0, 0]
    np.testing.assert_array_equal(links.rx, moved[[0, 1, 2]])
    np.testing.assert_allclose(links.gain_db, GAIN_DB[[2, 0, 1]])
    np.testing.assert_allclose(variance, (1.0 + 1.0 + 9.0 + 9.0) / (3 + 10) / np.array([3, 2, 1]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gain_db": GAIN_DB[:, None]}, "gain_db has shape (3, 1): give one gain for each link, (N,)."),
        ({"gain_db": [-70.0, np.nan, np.nan]}, "gain_db[1] = nan (and 1 more) is not allowed: give finite numbers"),
        ({"gain_db": [70.0, 80.0, 90.0]}, "gain_db[0] = 70 (and 2 more) is not allowed: path gains are negative;"),
        ({"gain_db": [-70.0, -80.0, -201.0]}, "gain_db[2] = -201 is not allowed: give dB, not below -200;"),
        ({"gain_db": "loud"}, "gain_db = 'loud' is not numeric: give"),
        ({"gain_db": np.ma.masked_less(GAIN_DB, -100.0)}, "gain_db has masked values"),
        ({"gain_db": GAIN_DB + 1j}, "is not numeric"),
        ({"gain_db": GAIN_DB.astype(str).astype(object)}, "is not numeric"),
        ({"tx": TX[:2]}, "tx has shape (2, 3) for 3 gains: give x, y, z of each link in metres, (3, 3)."),
        ({"tx": None, **FLAT, "tx_y": TX[:2, 1]}, "tx_x, tx_y and tx_z have shapes (3,), (2,), (3,): give one"),
        ({"gain_db": None}, "gain_db is missing from measurements of type dict: give a mapping"),
        ({"rx": None}, "rx is missing from the measurements: give a mapping"),
        ({"rx": [[1.0, 2.0, 3.0], [1.0, np.nan, 3.0], [0, 0, 1]]}, "rx[1, 1] = nan is not allowed: give finite"),
        ({"tx": Frame({"tx": [(1, 2, 3), (1, 2), (0, 0, 1)]})["tx"]}, "is not numeric: give finite numbers"),
    ],
)
def test_what_is_unusable(changes: dict[str, object], message: str) -> None:
    with pytest.raises(MeasurementError, match=re.escape(message)):
        measurements_of({**FIELDS, **changes})


def test_outages_and_links_that_are_too_many_to_be_merged() -> None:
    assert Measurements(TX, RX, np.array([-139.9, -150.0, -157.0])).is_outage.tolist() == [False, True, True]
    rx = np.column_stack([np.arange(6001) * 0.02, np.ones(6001), np.ones(6001)])
    with pytest.raises(MeasurementError, match="has 6,001 links that are not repetitions, more than 3,000: give"):
        merged(Measurements(TX[0], rx, np.full(6001, -80.0)))


DOTS = "is not a number: write decimal points."
OWN = {"rx_x": "east", "rx_y": "north", "gain_db": "level"}
REFUSED_CSV = [
    (None, None, "measured.csv' cannot be read (No such file or directory): check the path"),
    (b"PK\x03\x04\xff\xfe", None, "measured.csv' cannot be read ("),
    ("tx_x,tx_y\n1,2\n", None, "with the columns tx_x, tx_y, tx_z, rx_x"),
    (f"{HEADER},gain_db\n1,2,1.5,3,4,1.5,-70,-71\n", None, "' has 2 columns of gain_db (gain_db, gain_db): keep one"),
    (f"{HEADER}\n1,2,1.5,3,4,1.5,-7", None, "' ends in '1,2,1.5,3,4,1.5,-7', without a line end: the file may be cut"),
    (f"{HEADER}\n1,2,1,5,3,4,1,5,-70\n", None, ", line 2 has 9 cells for 7 columns: separate columns by commas, and"),
    ("tx_x;tx_y;gain_db\n1,5;2,0;-70,5\n", None, "' has the header 'tx_x;tx_y;gain_db': separate columns by commas,"),
    (f'{HEADER}\n"1,5",2,1.5,3,4,1.5,-70\n', None, f"line 2: tx_x = '1,5' {DOTS}"),
    (f"{HEADER}\n1,2,1.5,3,4,1.5,-70\n\n1,2,1.5,3,4,1.5\n", None, "line 4: gain_db = '' is not a number: correct the"),
    ("rx_x,rx_y,x,gain_db\n3.0,2.0,1,-52\n", None, "2 columns of rx_x (rx_x, x): keep one"),
    ("x,y,rssi\n1,2,-52\n", ["rssi"], "columns = ['rssi'] is no mapping: name the headers of a file, as columns"),
    ("x,y,rssi\n", None, "has a header and no rows"),
    ("x,y,rssi,gain_db\n1,2,-52,-60\n", None, "has 2 columns of gain_db (a gain and a power)"),
    ("x,y,level\n1,2,-52\n", None, "as columns={'gain_db': 'HEADER'} of load_measurements or --column gain_db=H"),
    ("east,north,level\n3.0,2.0,-52\n", OWN | {"rx_z": "up"}, "has no column 'up'"),
    ("east,north,level\n3.0,2.0,-52\n", {"rssi": "level"}, "give a header for some of tx_x"),
]


@pytest.mark.parametrize(("content", "columns", "message"), REFUSED_CSV, ids=lambda value: repr(value)[:40])
def test_csv_that_would_be_misread(tmp_path: Path, content: str | bytes | None, columns: Any, message: str) -> None:
    path = tmp_path / "measured.csv"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(MeasurementError, match=re.escape(message)):
        sp.load_measurements(path, columns=columns)


class TestSurveys:
    @pytest.mark.parametrize(("header", "columns"), [("X,Y,RSSI,ssid", None), ("east,north,level,x", OWN)])
    def test_headers(self, tmp_path: Path, header: str, columns: Any) -> None:
        path = csv_file(tmp_path, f"{header}\n3.0,2.0,-52,0\n5.0,4.0,-61,0\n")
        measured = sp.load_measurements(path, columns=columns, tx=(1.0, 2.0, 2.0), tx_power_dbm=20.0)
        assert measured.rx.tolist() == [[3.0, 2.0, 1.5], [5.0, 4.0, 1.5]]
        assert measured.gain_db.tolist() == [-72.0, -81.0]
        assert not sp.load_measurements(path, columns=columns).tx_known.any()

    @pytest.mark.parametrize(
        ("header", "columns", "gain_db"),
        [
            ("rssi", None, -72.0),
            ("level", {"gain_db": "level"}, -72.0),
            ("gain_db", None, -52.0),
            ("Gain", {"gain_db": "Gain"}, -52.0),
        ],
    )
    def test_the_transmit_power_is_subtracted_from_powers_only(self, tmp_path, caplog, header, columns, gain_db):
        path = csv_file(tmp_path, f"x,y,{header}\n3.0,2.0,-52\n")
        measured = sp.load_measurements(path, columns=columns, tx_power_dbm=20.0)
        assert measured.gain_db.tolist() == [gain_db]
        assert ("tx_power_dbm = 20 is not subtracted" in caplog.text) == (gain_db == -52.0)

    def test_unused_columns_and_positions_are_named(self, tmp_path, caplog):
        path = csv_file(tmp_path, "tx_x,tx_y,rx_x,rx_y,gain_db,ssid\n1,2,3,2,-52,1\n")
        assert sp.load_measurements(path, tx=(5.0, 5.0, 1.5)).tx.tolist() == [[5.0, 5.0, 1.5]]
        assert "columns that are not known are not used (ssid)" in caplog.text
        assert "tx is used instead of the columns tx_x and tx_y" in caplog.text


def test_each_measurement_belongs_to_the_nearest_transmitter() -> None:
    sources_m = [np.array([[x, 1.0, 1.5]]) for x in (1.0, 1.3, 9.0, 9.0)]
    tx = np.array([[1.0, 1.0, 1.5], [1.2, 1.0, 1.5], [1.6, 1.0, 1.5], [5.0, 1.0, 1.5], [9.1, 1.0, 1.5]])
    expected = [[1, 0, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 0, 0, 1], [0, 0, 0, 0, 1]]
    np.testing.assert_array_equal(nearest_transmitters(tx, sources_m), expected)
