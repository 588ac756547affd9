"""Links of a data set with what they were traced with, and the check that a predictor knows such links."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from sionna_partial.datasets.link_table import LinkTable
from sionna_partial.datasets.shards import INDEX_FILE, read_dataset
from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import NetworkKind, PredictorSettings


@dataclass(frozen=True)
class LinkTraces:
    """How links were traced.

    Parameters
    ----------
    frequency_hz : float
        Carrier frequency [Hz].
    diffraction : bool
        Whether paths were diffracted, on plans, where that is the default.
    """

    frequency_hz: float
    diffraction: bool

    @classmethod
    def of_settings(cls, settings: PredictorSettings) -> "LinkTraces":
        """Return the traces that a predictor was, or shall be, trained on."""
        return cls(settings.frequency_hz, settings.diffraction)

    def __str__(self) -> str:
        """Say it in words."""
        return f"at {self.frequency_hz / 1e9:g} GHz {'with' if self.diffraction else 'without'} diffraction"

    def is_like(self, other: "LinkTraces") -> bool:
        """Whether frequency (within 1e-6) and diffraction are the same."""
        alike = math.isclose(self.frequency_hz, other.frequency_hz, rel_tol=1e-6)
        return alike and self.diffraction == other.diffraction


Dataset = LinkTable | str | PathLike[str] | Sequence[str | PathLike[str]]
"""Links, or one or more folders that `sionna-partial dataset` wrote."""


def open_links(dataset: Dataset) -> tuple[LinkTable, LinkTraces | None]:
    """Return the links of data sets, and how they were traced; None for a table, which does not say so.

    Parameters
    ----------
    dataset : LinkTable, path-like, or sequence of path-like
        Links, or folders that `sionna-partial dataset` wrote. A home may be in several of them, explored anew in each.

    Returns
    -------
    LinkTable, LinkTraces or None

    Raises
    ------
    PredictorError
        If a folder holds no data set, or is damaged; if the links were traced differently, or homes of one name differ;
        or if there is no link.
    """
    if isinstance(dataset, LinkTable):
        links, traces = dataset, None
    else:
        folders = _folders(dataset)
        tables = [read_dataset(folder) for folder in folders]
        traces = _one_kind(folders)
        _require_same_homes(folders, tables)
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
    return [Path(each) for each in folders]


def _one_kind(folders: Sequence[Path]) -> LinkTraces:
    """Read how the links of data sets were traced."""
    first, *others = (_read_traces(folder / INDEX_FILE) for folder in folders)
    for folder, found in zip(folders[1:], others, strict=True):
        remedy = "give data sets that were traced alike."
        require_like(found, first, f"'{folders[0]}'", remedy, dataset=f"'{folder}'")
    return first


def _require_same_homes(folders: Sequence[Path], tables: Sequence[LinkTable]) -> None:
    """Refuse two homes of one name."""
    known: dict[str, PartialMap] = {}
    for folder, table in zip(folders, tables, strict=True):
        for name, home in table.complete_maps.items():
            if known.setdefault(name, home) != home:
                raise PredictorError(f"'{folder}' has another home {name!r} than those before: give one of the two.")


def settings_for(
    traces: LinkTraces | None,
    *,
    networks: NetworkKind = "map",
    passes: int = PredictorSettings.passes,
    seed: int = PredictorSettings.seed,
) -> PredictorSettings:
    """Return settings of a training on such links.

    Parameters
    ----------
    traces : LinkTraces or None
        None takes the defaults.
    networks, passes, seed
        As in PredictorSettings.

    Returns
    -------
    PredictorSettings

    Raises
    ------
    SettingsError
        For a value out of range.
    """
    known = traces or LinkTraces.of_settings(PredictorSettings())
    return PredictorSettings(networks, known.frequency_hz, known.diffraction, passes, seed=seed)


def require_like(
    found: LinkTraces | None, wanted: LinkTraces, whose: str, remedy: str, *, dataset: str = "dataset"
) -> None:
    """Raise a PredictorError if the links of a data set were traced otherwise than `wanted`.

    Parameters
    ----------
    found : LinkTraces or None
        Of the data set; None is not known, and goes.
    wanted : LinkTraces
    whose : str
        Who wants them, for the message.
    remedy : str
    dataset : str
        What the message calls the data set.
    """
    if found is not None and not found.is_like(wanted):
        raise PredictorError(f"{dataset} was traced {found}, {whose} {wanted}: {remedy}")


def _read_traces(index: Path) -> LinkTraces:
    try:
        trace = json.loads(index.read_text(encoding="utf-8"))["settings"]["trace"]
        return LinkTraces(float(trace["frequency_hz"]), trace["diffraction"] is not False)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PredictorError(f"'{index}' is damaged ({error!r}): build the data set again in a new folder.") from error
