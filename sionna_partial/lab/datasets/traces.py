"""Data sets of several folders as one, and the settings of their traces, which must be alike."""

import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

from sionna_partial.errors import PredictorError, SettingsError
from sionna_partial.lab.datasets.shards import INDEX_FILE, read_dataset, read_index
from sionna_partial.lab.datasets.table import LinkTable
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import NetworkKind, PredictorSettings, TraceSettings

Dataset = LinkTable | str | PathLike[str] | Sequence[str | PathLike[str]]
"""Links, or one or more folders of data sets."""


@dataclass(frozen=True)
class LinkTraces:
    """Settings of the traces: carrier frequency [Hz], diffraction on plans, paths through walls."""

    frequency_hz: float
    diffraction: bool
    through_walls: bool = False

    @classmethod
    def of_settings(cls, settings: PredictorSettings) -> "LinkTraces":
        """Return the traces of a predictor's training links."""
        return cls(settings.frequency_hz, settings.diffraction, settings.through_walls)

    def __str__(self) -> str:
        where = f"at {self.frequency_hz / 1e9:g} GHz{' through walls' if self.through_walls else ''}"
        return f"{where} {'with' if self.diffraction else 'without'} diffraction"

    def is_like(self, other: "LinkTraces") -> bool:
        """Return whether frequency (within 1e-6), diffraction and paths through walls are equal."""
        same_frequency = math.isclose(self.frequency_hz, other.frequency_hz, rel_tol=1e-6)
        return same_frequency and replace(self, frequency_hz=other.frequency_hz) == other


def open_links(dataset: Dataset) -> tuple[LinkTable, LinkTraces | None]:
    """Return the links of data sets and their traces, None for a table; a home may be in several folders."""
    if isinstance(dataset, LinkTable):
        links, traces = dataset, None
    else:
        folders = _folders(dataset)
        tables = [read_dataset(folder) for folder in folders]
        traces = _read_traces(folders[0])
        homes: dict[str, PartialMap] = {}
        for folder, table in zip(folders, tables, strict=True):
            remedy = "give data sets that were traced with the same settings."
            require_like(_read_traces(folder), traces, f"'{folders[0]}'", remedy, dataset=f"'{folder}'")
            for name, home in table.complete_maps.items():
                if homes.setdefault(name, home) != home:
                    raise PredictorError(
                        f"'{folder}' has another home {name!r} than those before: give one of the two."
                    )
        links = LinkTable.concatenate(tables)
    if links.anywhere.all():
        raise PredictorError("dataset has no links with receivers drawn indoors: build one that has homes and links.")
    return links, traces


def _folders(dataset: str | PathLike[str] | Sequence[str | PathLike[str]]) -> list[Path]:
    folders = [dataset] if isinstance(dataset, (str, PathLike)) else dataset
    named = isinstance(folders, Sequence) and all(isinstance(each, (str, PathLike)) for each in folders)
    if not named or not folders:
        raise PredictorError(
            f"dataset = {dataset!r} is not allowed: give a LinkTable, or one or more folders that "
            "`sionna-partial dataset` wrote."
        )
    paths = [Path(each) for each in folders]
    twice = [
        path for path, count in Counter(path.resolve() for path in paths if os.path.exists(path)).items() if count > 1
    ]
    if twice:
        raise PredictorError(f"dataset has '{twice[0]}' twice, whose links would count twice: give it once.")
    return paths


def settings_for(
    traces: LinkTraces | None,
    *,
    networks: NetworkKind = "map",
    passes: int = PredictorSettings.passes,
    seed: int = PredictorSettings.seed,
) -> PredictorSettings:
    known = traces or LinkTraces.of_settings(PredictorSettings())
    return PredictorSettings(
        networks, known.frequency_hz, known.diffraction, passes, seed=seed, through_walls=known.through_walls
    )


def require_like(
    found: LinkTraces | None, wanted: LinkTraces, whose: str, remedy: str, *, dataset: str = "dataset"
) -> None:
    """Raise a PredictorError unless the links were traced like `whose` links; None passes."""
    if found is not None and not found.is_like(wanted):
        raise PredictorError(f"{dataset} was traced {found}, {whose} {wanted}: {remedy}")


def _read_traces(folder: Path) -> LinkTraces:
    index = read_index(folder)
    try:
        trace = TraceSettings(**index["settings"]["trace"])
        return LinkTraces(trace.frequency_hz, trace.diffraction is not False, trace.through_walls)
    except (ValueError, KeyError, TypeError, AttributeError, SettingsError) as error:
        path = folder / INDEX_FILE
        raise PredictorError(f"'{path}' is damaged ({error!r}): build the data set again in a new folder.") from error
