"""Links of a data set with what they were traced with, and the check that a predictor knows such links."""

import json
import math
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from sionna_partial.errors import PredictorError
from sionna_partial.settings import NetworkKind, PredictorSettings
from sionna_partial.training.link_table import LinkTable
from sionna_partial.training.shards import INDEX_FILE, read_dataset


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


def open_links(dataset: LinkTable | str | PathLike[str]) -> tuple[LinkTable, LinkTraces | None]:
    """Return the links of a data set, and how they were traced; None for a table, which does not say so.

    Parameters
    ----------
    dataset : LinkTable or path-like
        Links, or a folder that `sionna-partial dataset` wrote.

    Returns
    -------
    LinkTable, LinkTraces or None

    Raises
    ------
    PredictorError
        If the folder holds no data set, or the data set no link, or if it is damaged.
    """
    if isinstance(dataset, LinkTable):
        links, traces = dataset, None
    elif isinstance(dataset, (str, PathLike)):
        links, traces = read_dataset(dataset), _read_traces(Path(dataset) / INDEX_FILE)
    else:
        raise PredictorError(
            f"dataset is of type {type(dataset).__name__}: give a LinkTable, or a folder that "
            "`sionna-partial dataset` wrote."
        )
    if links.anywhere.all():
        raise PredictorError("dataset has no links with receivers drawn indoors: build one that has homes and links.")
    return links, traces


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


def require_like(found: LinkTraces | None, wanted: LinkTraces, whose: str, remedy: str) -> None:
    """Raise a PredictorError if the links of a data set were traced otherwise than `wanted`.

    Parameters
    ----------
    found : LinkTraces or None
        Of the data set; None is not known, and goes.
    wanted : LinkTraces
    whose : str
        Who wants them, for the message.
    remedy : str
    """
    if found is not None and not found.is_like(wanted):
        raise PredictorError(f"dataset was traced {found}, {whose} {wanted}: {remedy}")


def _read_traces(index: Path) -> LinkTraces:
    try:
        trace = json.loads(index.read_text(encoding="utf-8"))["settings"]["trace"]
        return LinkTraces(float(trace["frequency_hz"]), trace["diffraction"] is not False)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PredictorError(f"'{index}' is damaged ({error!r}): build the data set again in a new folder.") from error
