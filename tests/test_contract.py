"""The contract with Sionna RT: it holds today, and every breach is named without an exception."""

import logging
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pytest

from sionna_partial.errors import BackendError
from sionna_partial.tracing import contract
from sionna_partial.tracing.contract import TESTED_VERSIONS, contract_breaches, sionna_version, warn_of_breaches
from sionna_partial.tracing.sionna_rt import load_sionna


@pytest.fixture(autouse=True)
def _fresh_process() -> Iterator[None]:
    """As in a new process: nothing looked at yet, nothing said; and so again for the tests that follow."""
    for function in (contract_breaches, warn_of_breaches):
        function.cache_clear()
    yield
    for function in (contract_breaches, warn_of_breaches):
        function.cache_clear()


@pytest.fixture
def buffers() -> ModuleType:
    load_sionna()
    from sionna.rt.path_solvers import paths_buffer

    return paths_buffer


class TestContractBreaches:
    def test_installed_version_keeps_the_contract(self) -> None:
        assert sionna_version() in TESTED_VERSIONS
        assert contract_breaches() == ()

    def test_names_are_found_and_others_are_not(self) -> None:
        load_sionna()
        for table in (contract.ARGUMENTS, contract.ATTRIBUTES, contract.NUMBERS):
            for name in table:
                module, _, last = name.rpartition(".")
                assert contract._find(name) is not None
                assert contract._find(f"{module}.other_{last}") is None

    @pytest.mark.parametrize("name", contract.BUFFER_FIELDS)
    def test_renamed_field(self, name: str, buffers: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
        made = buffers.PathsBuffer.__init__

        def renamed(self: Any, buffer_size: int, max_depth: int, diffraction: bool) -> None:
            made(self, buffer_size, max_depth, diffraction)
            self.__dict__[f"{name}_2"] = self.__dict__.pop(name)

        monkeypatch.setattr(buffers.PathsBuffer, "__init__", renamed)
        assert contract_breaches() == (f"PathsBuffer has no field {name}",)

    def test_fields_of_another_kind(self, buffers: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
        made = buffers.PathsBuffer.__init__

        def changed(self: Any, buffer_size: int, max_depth: int, diffraction: bool) -> None:
            made(self, buffer_size, max_depth + 1, diffraction)
            self._shapes = self._vertices_x
            self._diffracting_wedges = None

        monkeypatch.setattr(buffers.PathsBuffer, "__init__", changed)
        breaches = contract_breaches()
        assert "PathsBuffer._vertices_y has shape (2, 4) in place of (2, 3)" in breaches
        assert "PathsBuffer._shapes is a TensorXf, not a TensorXu" in breaches
        assert "PathsBuffer._diffracting_wedges is a NoneType, not a WedgeGeometry" in breaches

    def test_buffer_that_cannot_be_made(self, buffers: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(self: Any, buffer_size: int, max_depth: int, diffraction: bool) -> None:
            raise ValueError("give a device")

        monkeypatch.setattr(buffers.PathsBuffer, "__init__", fail)
        assert contract_breaches() == ("PathsBuffer(2, 3, True) fails (ValueError('give a device'))",)

    def test_other_arguments(self, monkeypatch: pytest.MonkeyPatch) -> None:
        rt = load_sionna()

        def call(
            self: Any, scene: Any, paths: Any, diffraction: bool, src_positions: Any, tgt_positions: Any, gpu: int
        ):
            raise NotImplementedError

        monkeypatch.setattr(rt.path_solvers.image_method.ImageMethod, "__call__", call)
        assert contract_breaches() == (
            "ImageMethod.__call__ takes no argument diffraction_lit_region",
            "ImageMethod.__call__ needs another argument, gpu",
        )

    def test_new_arguments_with_defaults_do_no_harm(self, monkeypatch: pytest.MonkeyPatch) -> None:
        rt = load_sionna()

        def make(self: Any, *others: int, fast: bool = True, **more: int) -> None:
            raise NotImplementedError

        monkeypatch.setattr(rt.path_solvers.image_method.ImageMethod, "__init__", make)
        assert contract_breaches() == ()

    def test_missing_property(self, buffers: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delattr(buffers.PathsBuffer, "target_indices")
        monkeypatch.delattr(load_sionna().SceneObject, "object_id")
        assert contract_breaches() == ("PathsBuffer has no target_indices", "SceneObject has no object_id")

    def test_other_number(self, monkeypatch: pytest.MonkeyPatch) -> None:
        load_sionna()
        from sionna.rt import constants

        monkeypatch.setattr(constants.InteractionType, "DIFFRACTION", 16)
        monkeypatch.delattr(constants, "INVALID_SHAPE")
        assert contract_breaches() == (
            "sionna.rt.constants.INVALID_SHAPE is missing",
            "InteractionType.DIFFRACTION is 16, not 8",
        )

    def test_missing_module(self, monkeypatch: pytest.MonkeyPatch) -> None:
        solvers = load_sionna().path_solvers
        monkeypatch.delattr(solvers, "paths_buffer")
        monkeypatch.setitem(sys.modules, "sionna.rt.path_solvers.paths_buffer", None)
        name = "sionna.rt.path_solvers.paths_buffer.PathsBuffer"
        assert contract_breaches() == (f"{name}.__init__ is missing", f"{name} is missing")

    def test_missing_sionna(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def missing() -> None:
            raise ModuleNotFoundError("No module named 'sionna'")

        monkeypatch.setattr(contract, "load_sionna", missing)
        message = "Sionna RT cannot be examined (ModuleNotFoundError(\"No module named 'sionna'\"))"
        assert contract_breaches() == (message,)

    def test_unusable_backend(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def unusable() -> None:
            raise BackendError("No LLVM can be used")

        monkeypatch.setattr(contract, "load_sionna", unusable)
        assert contract_breaches() == ("No LLVM can be used",)


class TestWarnOfBreaches:
    def test_says_once_what_is_wrong_what_follows_and_what_to_do(
        self, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(contract.metadata, "version", lambda _: "2.3.0")
        with caplog.at_level(logging.WARNING):
            for _ in range(3):
                warn_of_breaches(("PathsBuffer has no field _shapes", "Scene has no objects"))
        (record,) = caplog.records
        assert record.getMessage() == (
            "sionna-rt 2.3.0 is not what the fast engine was made for (PathsBuffer has no field _shapes; Scene has no "
            "objects). Its public path solver is used instead: it gives most paths, and takes seconds for each "
            'receiver: run pip install "sionna-rt==2.2.0" to have the fast engine back.'
        )


def test_version_of_what_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise contract.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(contract.metadata, "version", missing)
    assert sionna_version() == ""
