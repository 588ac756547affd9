"""The report of what is found: every fault comes with what to do."""

import platform
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sionna_partial import info
from sionna_partial.cli.app import app
from sionna_partial.info import Finding
from sionna_partial.llvm import load_llvm
from sionna_partial.resources import demo_homes
from sionna_partial.tracing.engine import engine_fault


@pytest.fixture
def fresh_engine() -> Iterator[None]:
    engine_fault.cache_clear()
    yield
    engine_fault.cache_clear()


def found() -> dict[str, Finding]:
    return {finding.name: finding for finding in info.findings()}


def test_this_machine_needs_nothing() -> None:
    findings, library = found(), load_llvm()
    assert not [finding for finding in findings.values() if finding.remedy]
    values = {name: finding.value for name, finding in findings.items()}
    assert values["LLVM"] == library.version
    assert values["LLVM library"] == str(library.path)
    assert values["LLVM source"] == library.source
    assert values["fast engine"] == "on"
    assert values["predictors"] == "map, paper"
    assert values["demo scenes"] == ", ".join(demo_homes())
    assert values["numpy"] == metadata.version("numpy")


@pytest.mark.usefixtures("command_line")
def test_report_of_a_map() -> None:
    path = Path(__file__).parent / "reports" / "dxf_layers" / "A-WALL-DEMO.dxf"
    result = CliRunner().invoke(app, ["info", str(path), "--unit", "0.5", "--wall-layer", "A-WALL*"])
    assert result.exit_code == 0, result.output
    assert "unit       0.5 m (unit_m)\nextent     6.05 x 4.05 m\nrooms      2\n" in result.stdout


@pytest.mark.usefixtures("fresh_engine")
def test_other_versions_and_another_platform(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name in ("keras", "shapely"):
            raise metadata.PackageNotFoundError(name)
        return "2.3.0"

    monkeypatch.setattr(metadata, "version", version)
    monkeypatch.setattr(metadata, "requires", lambda _: ["keras<4,>=3", "shapely>=2", "scipy", 'ruff; extra == "dev"'])
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    findings = found()
    remedy = "run pip install {}, or install sionna-partial again."
    assert findings["keras"] == Finding("keras", "not installed", remedy.format("keras"))
    assert findings["shapely"] == Finding("shapely", "not installed", remedy.format("shapely"))
    assert not {"scipy", "ruff"} & findings.keys()
    assert findings["fast engine"].value.startswith("off: sionna-rt 2.3.0 is not of the release 2.2")
    assert findings["fast engine"].remedy == 'run pip install "sionna-rt==2.2.*" to have the fast engine back.'
    assert findings["Python"].remedy.startswith("sionna-partial is made for x86-64 Linux")
