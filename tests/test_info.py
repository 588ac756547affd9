"""The report of what is found: every fault comes with what to do."""

import platform
from importlib import metadata
from pathlib import Path

import pytest

from sionna_partial import info
from sionna_partial.errors import SceneError
from sionna_partial.info import Finding
from sionna_partial.llvm import load_llvm
from sionna_partial.resources import demo_homes


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


def test_sionna_rt_of_another_make(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(info, "engine_fault", lambda: "sionna-rt 2.3.0 is not of the release 2.2")
    remedy = 'run pip install "sionna-rt==2.2.*" to have the fast engine back.'
    assert found()["fast engine"] == Finding("fast engine", "off: sionna-rt 2.3.0 is not of the release 2.2", remedy)


def test_missing_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name in ("keras", "shapely"):
            raise metadata.PackageNotFoundError(name)
        return "2.2.0"

    monkeypatch.setattr(metadata, "version", version)
    monkeypatch.setattr(metadata, "requires", lambda _: ["keras<4,>=3", "shapely>=2", "scipy", 'ruff; extra == "dev"'])
    findings = found()
    remedy = "run pip install {}, or pip install sionna-partial again."
    assert findings["keras"] == Finding("keras", "not installed", remedy.format("keras"))
    assert findings["shapely"] == Finding("shapely", "not installed", remedy.format("shapely"))
    assert not {"scipy", "ruff"} & findings.keys()


def test_missing_data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fail() -> None:
        raise SceneError("install again")

    monkeypatch.setattr(info, "PREDICTORS_FOLDER", tmp_path)
    monkeypatch.setattr(info, "demo_homes", fail)
    findings = found()
    remedy = f"'{tmp_path}' holds none: install sionna-partial again."
    assert findings["predictors"] == Finding("predictors", "none", remedy)
    assert findings["demo scenes"] == Finding("demo scenes", "none", "install again")


def test_other_platform(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert found()["Python"].remedy.startswith("sionna-partial is made for x86-64 Linux")
