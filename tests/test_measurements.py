"""Measurements: every form gives the same arrays, and what is unusable is named."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray
from PIL import Image

import sionna_partial as sp
from sionna_partial.errors import MeasurementError
from sionna_partial.measurements.measurements import Measurements, measurements_of, merged
from sionna_partial.measurements.selection import nearest_transmitters

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


DOTS = "is not a number: separate columns by commas and write decimal points, or separate them by semicolons."
OWN = {"rx_x": "east", "rx_y": "north", "gain_db": "level"}
REFUSED_CSV = [
    (None, None, "measured.csv' cannot be read (No such file or directory): check the path"),
    (b"x,y,rssi\n1,2,\xff\xfe\n", None, "measured.csv' cannot be read ("),
    (b"PK\x03\x04\xff\xfe", None, "measured.csv' is a zip, as .xlsx, and no CSV: give a CSV with the columns x, y in"),
    ("tx_x,tx_y\n1,2\n", None, "with the columns tx_x, tx_y, tx_z, rx_x"),
    (f"{HEADER},gain_db\n1,2,1.5,3,4,1.5,-70,-71\n", None, "' has 2 columns of gain_db (gain_db, gain_db): keep one"),
    (f"{HEADER}\n1,2,1.5,3,4,1.5,-7", None, "' ends in '1,2,1.5,3,4,1.5,-7', without a line end: the file may be cut"),
    (f"{HEADER}\n1,2,1,5,3,4,1,5,-70\n", None, ", line 2 has 9 cells for 7 columns: separate columns by commas and w"),
    ("tx_x;tx_y;gain_db\n1,5;2,0;-70,5\n", None, "rx_x is missing from measurements 'measured.csv': name the headers"),
    (f'{HEADER}\n"1,5",2,1.5,3,4,1.5,-70\n', None, f"line 2: tx_x = '1,5' {DOTS}"),
    (f"{HEADER}\n1,2,1.5,3,4,1.5,-70\n\n1,2,1.5,3,4,1.5\n", None, "line 4: gain_db = '' is not a number: correct the"),
    ("rx_x,rx_y,x,gain_db\n3.0,2.0,1,-52\n", None, "2 columns of rx_x (rx_x, x): keep one"),
    ("x,y,rssi\n1,2,-52\n", ["rssi"], "columns = ['rssi'] is no mapping: name the headers of a file, as columns"),
    ("x,y,rssi\n", None, "has a header and no rows"),
    ("x,y,rssi,gain_db\n1,2,-52,-60\n", None, "has 2 columns of gain_db (a gain and a power)"),
    (
        "x,y,RSSI\n1,2,-52\n# pause\n1,3,70\n1,4,75\n",
        None,
        "measurements 'measured.csv', line 4: RSSI = 70 dBm (and 1 more) is not allowed: with tx_power_dbm = 0, "
        "received powers are -200 to 0 dBm; percentages are not read.",
    ),
    ("x,y,gain_db\n1,2,70\n", None, "line 2: gain_db = 70 dB is not allowed: path gains are negative; give minus"),
    ("East,y,rssi\n1,2,-52\nnan,2,-52\n", {"rx_x": "East"}, "line 3: East = nan m is not allowed: give finite numbers"),
    ("lat,lon,rssi\n48.1,11.5,-52\n", None, "has positions in degrees (lat, lon): give a CSV with the columns x, y in"),
    ("Lat,Lon,rssi\n48.1,11.5,-52\n", {"rx_x": "Lon", "rx_y": "Lat"}, "has positions in degrees (Lon, Lat): give a"),
    ("SSID,BSSID,Channel,Signal,Security,Vendor\nn,02:0a,6,-50,WPA2,v\n", None, "an export of NetSpot, without positi"),
    ("Network;NetType;ESSID;BSSID\n1;infra;n;02:0a\n", None, "is an export of Kismet, without positions: give a CSV"),
    (
        b"SQLite format 3\0\xff",
        None,
        "is an SQLite database, as of Kismet or a GeoPackage, and no CSV: give a CSV with",
    ),
    ('[{"x": 1, "y": 2}]', None, "is damaged or no JSON survey"),
    ("[]", None, "measurements 'measured.csv' has no survey points: check that it was written completely."),
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


REPORTS = Path(__file__).parent / "reports"
A, B = "02:00:00:00:00:0a", "02:00:00:00:00:0b"


class TestAccessPoints:
    """Several access points in one file are told apart, and never averaged."""

    BOTH = REPORTS / "access_points" / "both.csv"

    def test_one_is_chosen(self) -> None:
        found = sp.load_measurements(self.BOTH, access_point=A.upper(), tx=(1.0, 1.0, 1.5))
        assert found.gain_db[:3].tolist() == [-22.5, -28.6, found.gain_db[2]]
        alone = sp.load_measurements(REPORTS / "access_points" / "a.csv", tx=(1.0, 1.0, 1.5))
        np.testing.assert_array_equal(found.rx, alone.rx)

    @pytest.mark.parametrize("name", ["both.csv", "mac.csv"])
    @pytest.mark.parametrize("tx", [None, (1.0, 1.0, 1.5)])
    def test_the_user_is_asked(self, name: str, tx: object) -> None:
        message = rf"measurements '{name}' has powers of 2 access points \(.*02:.*: \d+, .*\): give the BSSID or name"
        with pytest.raises(MeasurementError, match=message):
            sp.load_measurements(REPORTS / "access_points" / name, tx=tx)
        with pytest.raises(MeasurementError, match=message):
            measurements_of(REPORTS / "access_points" / name)

    def test_all_have_their_positions(self, caplog: pytest.LogCaptureFixture) -> None:
        found = sp.load_measurements(self.BOTH, tx={B: (11.0, 7.0, 1.5), A: (1.0, 1.0, 1.5)})
        parts = [sp.load_measurements(self.BOTH, access_point=name) for name in (B, A)]
        np.testing.assert_array_equal(found.gain_db, np.concatenate([part.gain_db for part in parts]))
        assert np.unique(found.tx, axis=0).tolist() == [[1.0, 1.0, 1.5], [11.0, 7.0, 1.5]]
        assert not caplog.text
        assert len(sp.load_measurements(self.BOTH, tx={A: (1.0, 1.0, 1.5)})) == len(parts[1])
        assert "rows are of access points without a position in tx, and not used" in caplog.text

    def test_names_that_fit_none_or_several(self, tmp_path: Path) -> None:
        with pytest.raises(MeasurementError, match="access_point = 'attic' names 0 access points of measurements"):
            sp.load_measurements(self.BOTH, access_point="attic")
        with pytest.raises(MeasurementError, match="access_point = 'home' names 2 access points of measurements 'both"):
            sp.load_measurements(self.BOTH, access_point="home")
        with pytest.raises(MeasurementError, match=r"access_point = 'a' names 0 access points of .* leave it out"):
            sp.load_measurements(csv_file(tmp_path, "x,y,rssi\n1,2,-50\n"), access_point="a")

    def test_columns_of_a_data_frame(self) -> None:
        columns = {"rx_x": [1.0, 2.0], "rx_y": [1.0, 1.0], "gain_db": [-50.0, -60.0]}
        with pytest.raises(MeasurementError, match=r"of type dict has powers of 2 access points \(a: 1, b: 1\): give"):
            measurements_of({**columns, "BSSID": ["a", "b"]})
        assert len(measurements_of({**columns, "BSSID": ["a", "a"], "tx_x": [1.0, 1.0], "tx_y": [1.0, 1.0]})) == 2


class TestSurveyPrograms:
    HEADERS = REPORTS / "survey_headers"

    def test_comments_before_the_header(self) -> None:
        measured = sp.load_measurements(self.HEADERS / "netsurvey.csv")
        assert measured.rx[:2].tolist() == [[3.25, 2.5, 1.5], [5.0, 4.75, 1.5]]
        assert measured.gain_db[:2].tolist() == [-52.0, -61.0]

    def test_the_program_is_named(self) -> None:
        message = "measurements 'wigle.csv' is an export of WiGLE, with positions in degrees: give a CSV with the"
        with pytest.raises(MeasurementError, match=message):
            sp.load_measurements(self.HEADERS / "wigle.csv")

    def test_pixels_of_a_plan(self, tmp_path: Path) -> None:
        path = Path(shutil.copy(self.HEADERS / "jantman.json", tmp_path))
        with pytest.raises(MeasurementError, match=r"pixels of the plan 'floor.png', and pixel_m = None: give pixel_m"):
            sp.load_measurements(path)
        with pytest.raises(MeasurementError, match=r"plan 'floor.png', which is not there: .* keep the plan beside"):
            sp.load_measurements(path, pixel_m=0.02)
        Image.new("L", (400, 300)).save(tmp_path / "floor.png")
        measured = sp.load_measurements(path, pixel_m=0.02)
        np.testing.assert_allclose(measured.rx[0], [3.24, 0.5, 1.5])
        assert measured.gain_db.tolist() == [-52.0, -61.0, -70.0, -83.0]
        with pytest.raises(MeasurementError, match=r"pixel_m = 0\.02 is for a survey on the pixels of a plan"):
            sp.load_measurements(self.HEADERS / "netsurvey.csv", pixel_m=0.02)

    @pytest.mark.parametrize(
        "text",
        [
            "x;y;rssi\n3,25;2,5;-52,5\n5;4,75;-61\n",
            "Survey of the hall, 2nd floor\n\nx\ty\trssi\n3,25\t2,5\t-52.5\n5\t4,75\t-61\n",
            "# x y rssi\n# x,y,rssi\n3.25,2.5,-52.5\n5,4.75,-61\n",
            '"X [m]","Y [m]","Signal Strength (dBm)"\n3.25,2.5,-52.5\n5,4.75,-61\n',
        ],
    )
    @pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
    def test_spreadsheets(self, tmp_path: Path, text: str, encoding: str) -> None:
        path = tmp_path / "measured.csv"
        path.write_bytes(text.encode(encoding))
        measured = sp.load_measurements(path)
        assert measured.rx[:, :2].tolist() == [[3.25, 2.5], [5.0, 4.75]]
        assert measured.gain_db.tolist() == [-52.5, -61.0]


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
        path = csv_file(tmp_path, "tx_x,tx_y,rx_x,rx_y,gain_db,note\n1,2,3,2,-52,1\n")
        assert sp.load_measurements(path, tx=(5.0, 5.0, 1.5)).tx.tolist() == [[5.0, 5.0, 1.5]]
        assert "columns that are not known are not used (note)" in caplog.text
        assert "tx is used instead of the columns tx_x and tx_y" in caplog.text


def test_each_measurement_belongs_to_the_nearest_transmitter() -> None:
    sources_m = [np.array([[x, 1.0, 1.5]]) for x in (1.0, 1.3, 9.0, 9.0)]
    tx = np.array([[1.0, 1.0, 1.5], [1.2, 1.0, 1.5], [1.6, 1.0, 1.5], [5.0, 1.0, 1.5], [9.1, 1.0, 1.5]])
    expected = [[1, 0, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 0, 0, 1], [0, 0, 0, 0, 1]]
    np.testing.assert_array_equal(nearest_transmitters(tx, sources_m), expected)
