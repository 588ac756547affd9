"""The decision for or against the fast engine."""

import logging
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from sionna_partial.errors import BackendError
from sionna_partial.tracing import probe
from sionna_partial.tracing.contract import warn_of_breaches
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.probe import differences, fast_engine_works, probe_breaches
from sionna_partial.tracing.solver import SceneSolver


@pytest.fixture(autouse=True)
def _fresh_process() -> Iterator[None]:
    """As in a new process, before the test and after it."""
    for function in (fast_engine_works, warn_of_breaches):
        function.cache_clear()
    yield
    for function in (fast_engine_works, warn_of_breaches):
        function.cache_clear()


def _paths() -> SolvedPaths:
    rx = np.array([[3.0, 0.0, 0.0], [0.0, 6.0, 0.0]])
    return SolvedPaths.of_vertices(
        path_rx=np.array([0, 1], np.int32),
        a=np.array([2e-4 + 0j, 1e-4 + 0j]),
        delay_s=np.array([1e-8, 2e-8]),
        interactions=np.zeros((2, 1), np.uint8),
        vertices_m=np.zeros((2, 1, 3)),
        tx_m=np.zeros(3),
        rx_m=rx,
    )


class TestProbeBreaches:
    def test_both_engines_agree_today(self) -> None:
        assert probe_breaches() == ()

    def test_wrong_coefficients_are_noticed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        verify = SceneSolver.verify
        monkeypatch.setattr(
            SceneSolver,
            "verify",
            lambda self, *given: (replace(paths := (found := verify(self, *given))[0], a=1.1 * paths.a), found[1]),
        )
        assert probe_breaches() == ("paths in a small room have other coefficients",)

    def test_failures_are_breaches(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*_: object) -> None:
            raise AttributeError("mi_mesh")

        monkeypatch.setattr(SceneSolver, "verify", fail)
        assert probe_breaches() == ("a small room cannot be solved (AttributeError('mi_mesh'))",)


class TestDifferences:
    def test_none(self) -> None:
        assert differences(_paths(), replace(_paths(), a=_paths().a * 1.001, delay_s=_paths().delay_s + 1e-13)) == []

    @pytest.mark.parametrize(
        ("other", "message"),
        [
            (replace(_paths(), a=np.ones(3)), "2 paths were found in a small room that has 3"),
            (replace(_paths(), path_rx=np.array([1, 1], np.int32)), "paths in a small room end at other receivers"),
            (replace(_paths(), delay_s=_paths().delay_s + 1e-11), "paths in a small room have other delays"),
            (replace(_paths(), a=_paths().a * 1j), "paths in a small room have other coefficients"),
        ],
    )
    def test_each_is_named(self, other: SolvedPaths, message: str) -> None:
        assert differences(_paths(), other) == [message]


class TestFastEngineWorks:
    def test_tested_version_is_not_tried(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def tried() -> tuple[str, ...]:
            raise AssertionError("a tested version was tried")

        monkeypatch.setattr(probe, "probe_breaches", tried)
        assert fast_engine_works()

    def test_other_version_is_tried(self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
        monkeypatch.setattr(probe, "sionna_version", lambda: "2.2.7")
        monkeypatch.setattr(probe, "probe_breaches", tuple)
        assert fast_engine_works()
        assert not caplog.records

    def test_broken_contract_is_not_tried_and_is_told_once(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setattr(probe, "contract_breaches", lambda: ("Scene has no objects",))
        monkeypatch.setattr(probe, "probe_breaches", None)
        with caplog.at_level(logging.WARNING):
            assert [fast_engine_works() for _ in range(3)] == [False] * 3
        (record,) = caplog.records
        assert "Scene has no objects" in record.getMessage()

    def test_without_llvm_no_engine_is_blamed(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        def unusable() -> None:
            raise BackendError("install one")

        monkeypatch.setattr(probe, "load_llvm", unusable)
        with pytest.raises(BackendError, match=r"^install one$"):
            fast_engine_works()
        assert not caplog.records

    def test_failed_trial(self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
        monkeypatch.setattr(probe, "sionna_version", lambda: "2.2.7")
        monkeypatch.setattr(probe, "probe_breaches", lambda: ("paths in a small room have other delays",))
        with caplog.at_level(logging.WARNING):
            assert not fast_engine_works()
        assert "paths in a small room have other delays" in caplog.text
