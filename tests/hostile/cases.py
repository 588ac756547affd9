"""Hostile inputs by rules: odd arguments, spoilt files, odd command lines, and a corpus of what once went wrong."""

import dataclasses
import inspect
import operator
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name

from inputs import KINDS

CORPUS = Path(__file__).with_name("corpus")
"""Python files of what once went wrong; each raises `Wrong` when it does again."""


@dataclass(frozen=True)
class Case:
    family: str
    name: str
    code: str
    is_random: bool = False


ODD = (
    *("None", "True", "'x'", "''", "float('nan')", "float('inf')", "-1", "0", "10**400", "1e308", "-0.0", "[]", "{}"),
    *("1j", "b'x'", "object()", "np.int64(3)", "np.float32(0.5)", "np.array([])", "np.zeros((2, 0, 3))", "'a' * 5000"),
    *("np.ma.masked_array([1.0, 2.0, 1.5], [0, 1, 0])", "np.array([1j, 2, 3])", "Path('/nonexistent')", "(1, 2)"),
    *("np.array([1, [2, 3]], dtype=object)", "((),)", "'1.0'", "np.datetime64('now')", "[[1.0, 1.0, 1.5]] * 2"),
    *("np.full((4, 5), 7)", "(1.0, 2.0, np.nan)", "range(3)", "iter([1, 2])", "'\\x00'", "Path('.')", "[None]"),
)
"""Values that are mostly not what an argument takes."""

CALLS = {
    "PartialMap": {"state": "np.zeros((5, 6), np.uint8)", "resolution_m": "0.1"},
    "map_from_array": {"array": "np.zeros((5, 6))", "resolution_m": "0.1"},
    "importers.map_from_occupancy": {"data": "np.zeros((5, 6), np.int8)", "resolution_m": "0.1"},
    "importers.map_from_slam": {"obstacle": "np.zeros((5, 6))", "explored": "np.ones((5, 6))", "resolution_m": "0.1"},
    "importers.map_from_habitat": {
        "top_down": "np.ones((5, 6), bool)",
        "fog_of_war": "np.ones((5, 6), bool)",
        "resolution_m": "0.1",
    },
    "importers.map_from_points": {"points": "CLOUD"},
    "importers.map_from_drawing": {"path": "valid('plan.dxf', folder)"},
    "importers.map_from_bag": {"path": "valid('drive.bag', folder)"},
    "importers.poses_from_bag": {"path": "valid('drive.bag', folder)"},
    "importers.measurements_from_bag": {
        **{"path": "valid('drive.bag', folder)", "topic": "'/rssi'", "tx": "TX"},
        "tx_power_dbm": "20.0",
    },
    "load_map": {"path": "valid('map.yaml', folder)"},
    "save_map": {"partial": "room()", "path": "folder / 'map.yaml'"},
    "export_scene": {"partial": "room()", "folder": "folder / 'scene'"},
    "make_home": {"seed": "1"},
    "explore": {"home": "room()", "steps": "(3,)"},
    "trace_links": {"scene": "room()", "tx": "TX", "rx": "[(3.1, 2.5, 1.5)]"},
    "gain_gradients": {"scene": "room()", "tx": "TX", "rx": "[(3.1, 2.5, 1.5)]"},
    "predict_map": {"scene": "room()", "tx": "TX", "spacing_m": "1.0", "predictor": "'paper'"},
    "save_coverage": {"coverage": "coverage()", "path": "folder / 'coverage.nc'"},
    "load_coverage": {"path": "valid('coverage.nc', folder)"},
    "plots.plot_coverage": {"coverage": "coverage()"},
    "plots.plot_map": {"partial": "room()"},
    "Measurements": {"tx": "[TX]", "rx": "[(3.1, 2.5, 1.5)]", "gain_db": "[-70.0]"},
    "link_features": {"partial": "room()", "links": "links()"},
    "measurements.assimilation.Assimilation.fit": {
        **{"partial": "room()", "tx_m": "TX", "measured": "measured()"},
        **{"prior": "prediction()"},
    },
    "TracedLinks.cir": {"self": "links()"},
    "TracedLinks.cfr": {"self": "links()", "frequencies_hz": "[0.0, 1e6]"},
    "TracedLinks.taps": {"self": "links()", "bandwidth_hz": "1e8"},
    "TracedLinks.beam_gains": {"self": "links()", "codebook": "np.ones((1, 1))"},
    "TracedLinks.to_dataframe": {"self": "links()"},
    "load_antenna": {"path": "valid('antenna.msi', folder)"},
    "Antenna": {"pattern": "'tr38901'", "azimuth_deg": "30.0", "rows": "2", "columns": "2", "beam": "1"},
    "channels.dft_codebook": {"rows": "4", "columns": "4"},
    "channels.sample_channels": {
        **{"scene": "room()", "tx": "TX", "rx": "[(3.1, 2.5, 1.5)]", "n": "5"},
        **{"predictor": "'paper'"},
    },
    "channels.samples.ChannelSamples.links": {"self": "samples()", "draw": "0"},
    "channels.save_channels": {"channels": "links()", "path": "folder / 'channels.nc'"},
    "channels.load_channels": {"path": "valid('channels.nc', folder)"},
    "predict_network": {"coverage": "two_coverages()"},
    "save_network": {"network": "network()", "path": "folder / 'network.nc'"},
    "plots.plot_network": {"network": "network()"},
    "calibrate_materials": {"scene": "room()", "measurements": "valid('measurements.csv', folder)"},
    "place_transmitter": {"scene": "room()", "predictor": "'paper'"},
    "place_transmitters": {"scene": "room()", "predictor": "'paper'"},
    "next_views": {"scene": "room()"},
    "plots.plot_calibration": {"calibration": "None"},
    "plots.plot_exploration": {"exploration": "None"},
    "plots.plot_placement": {"placement": "None"},
    "plots.plot_network_placement": {"placement": "None"},
    "plots.plot_next_views": {"views": "None"},
    "explore_trajectory": {"home": "room()", "steps": "3"},
    "DifferentiableScene": {"scene": "room()"},
    "Predictor.predict": {"self": "sp.Predictor.load('paper')", "features": "None"},
    "plots.animate_exploration": {"exploration": "None", "path": "folder / 'drive.gif'"},
    "lab.build_dataset": {"folder": "folder / 'links'", "homes": "[]"},
    "lab.read_dataset": {"folder": "valid('dataset.json', folder).parent"},
    "lab.train": {"dataset": "valid('dataset.json', folder).parent"},
    "lab.evaluate": {"predictor": "'paper'", "dataset": "valid('dataset.json', folder).parent"},
}
"""Public functions and methods, and valid arguments of each."""

SETTINGS = ("TraceSettings", "SceneSettings", "SensorSettings", "lab.DatasetSettings", "Material")

COMMANDS = {
    "predict": "MAP --tx 1.1 1.1 --spacing 1.0 --predictor paper --out OUT",
    "export-scene": "MAP --out OUT",
    "explore": "--seed 1 --steps 3 --out OUT",
    "dataset": "OUT --homes 0",
    "train": "LINKS --out OUT",
    "evaluate": "LINKS --predictor paper --out OUT",
    "calibrate": "MAP --measurements CSV --out OUT",
    "place": "MAP --predictor paper --out OUT",
    "channels": "MAP --tx 1.1 1.1 --spacing 1.0 --array 2x2 --out FILE",
    "network": "MAP --tx 1.1 1.1 --tx 2.5 2.5 --spacing 1.0 --predictor paper --out OUT",
    "next": "MAP --tx 1.1 1.1 --out OUT",
    "info": "",
}
"""Subcommands, and what makes each work."""

WORDS = (
    *("", "-1", "nan", "inf", "1e999", "x" * 300, "--help", "--", "/dev/null", "/dev/zero", "/", ".", "~", "\\udcff"),
    *("--out", "1,5", "0x10", "é", "'; rm -rf /'", "$(id)", "../..", "--frequency", "--tx"),
)

TOKENS = ("nan", "inf", "-1", "1e999", "0", "9" * 400, "", "x", "[[", "{", "1,5", "&a", "*a", "true", "null", "..")

SPOILS = (
    "data[: int(len(data) * rng.random())]",
    "b''",
    "data + bytes(rng.randrange(256) for _ in range(50))",
    "data * 2",
    "data.replace(b'\\n', b'\\r\\n')",
    "data.replace(b'\\n', b'\\r')",
    "b'\\xef\\xbb\\xbf' + data",
    "flipped(data, rng, 1)",
    "flipped(data, rng, 20)",
    "without_lines(data, rng)",
    "lines_twice(data, rng)",
    "shuffled(data, rng)",
    "with_token(data, rng)",
    "with_token(with_token(data, rng), rng)",
    "data.decode('latin-1').encode('utf-16')",
    "bytes(len(data))",
)
"""Expressions of the bytes `data` of a valid file and a random generator `rng`."""

STOPPED = COMMANDS | {"dataset": "OUT --homes 2", "train": "LINKS --out OUT --networks paper --test-fraction 0"}
"""Subcommands that get a signal in the middle of what they do, and are then called again."""

STOPPED_AFTER_S = (0.1, 10.0)
"""When, in processor time; before, Python itself starts, and answers Ctrl-C with a traceback."""

SIGNALS = ("SIGINT", "SIGTERM", "SIGKILL")

FAMILIES = ("settings", "arguments", "files", "command line", "signals", "corpus")

_INPUTS = "from inputs import *\n"
_SPOIL = """import random
from spoil import *
rng = random.Random({seed})
path = valid({kind!r}, folder)
data = path.read_bytes()
path.write_bytes({spoil})
read({kind!r}, path)
"""


def cases_of(family: str, seed: int) -> list[Case]:
    makers = {
        "settings": _settings,
        "arguments": _arguments,
        "files": _files,
        "command line": _command_line,
        "signals": _signals,
        "corpus": _corpus,
    }
    return list(makers[family](seed))


def _settings(seed: int) -> Iterator[Case]:
    import sionna_partial as sp

    for name in SETTINGS:
        for each in dataclasses.fields(operator.attrgetter(name)(sp)):
            for odd in ODD:
                code = f"sp.{name}({each.name}={odd})"
                yield Case("settings", code, code)


def _arguments(seed: int) -> Iterator[Case]:
    for name, base in CALLS.items():
        every = inspect.signature(resolve_name(f"sionna_partial.{name}")).parameters.values()
        left_out = ("self", "progress")
        parameters = [each.name for each in every if each.name not in left_out and each.kind != each.VAR_KEYWORD]
        for parameter in parameters:
            for odd in ODD:
                given = ", ".join(f"{key}={value}" for key, value in (base | {parameter: odd}).items())
                code = f"resolve_name('sionna_partial.{name}')({given})"
                yield Case("arguments", f"{name}({parameter}={odd})", _INPUTS + code)


def _files(seed: int) -> Iterator[Case]:
    for kind in KINDS:
        for number, spoil in enumerate(SPOILS):
            name = f"{kind}: {spoil} (seed {seed})"
            code = _INPUTS + _SPOIL.format(seed=1000 * seed + number, kind=kind, spoil=spoil)
            yield Case("files", name, code, is_random=True)


def _command_line(seed: int) -> Iterator[Case]:
    rng = random.Random(seed)
    for name, usual in COMMANDS.items():
        words = usual.split()
        for _ in range(12):
            spoilt = list(words)
            for _ in range(rng.randint(1, 2)):
                at, word = rng.randrange(len(spoilt) + 1), rng.choice(WORDS)
                spoilt[at : at + rng.randint(0, 1)] = [word]
            yield _command([name, *spoilt])


def _command(words: list[str]) -> Case:
    return Case("command line", " ".join(words)[:200], f"{_INPUTS}command({_arguments_of(words)})", is_random=True)


def _signals(seed: int) -> Iterator[Case]:
    rng = random.Random(seed)
    for name, usual in STOPPED.items():
        words, number, after_s = [name, *usual.split()], rng.choice(SIGNALS), rng.uniform(*STOPPED_AFTER_S)
        stop = f"words = [{_arguments_of(words)}]\nmust_end_at_signal(words, signal.{number}, {after_s})\n"
        again = "try:\n    command(*words)\nexcept Exception as error:\n    raise Wrong(str(error)) from error\n"
        yield Case("signals", f"{name}: {number} after {after_s:.2f} s", _INPUTS + stop + again, is_random=True)


def _arguments_of(words: list[str]) -> str:
    made = {
        "MAP": "valid('map.yaml', folder)",
        "OUT": "folder / 'out'",
        "FILE": "folder / 'channels.nc'",
        "CSV": "valid('measurements.csv', folder)",
        "LINKS": "valid('dataset.json', folder).parent",
    }
    return ", ".join(made.get(word, repr(word)) for word in words)


def _corpus(seed: int) -> Iterator[Case]:
    for path in sorted(CORPUS.glob("*.py")):
        yield Case("corpus", path.stem, _INPUTS + path.read_text(encoding="utf-8"))
