"""Links of many homes at several stages of exploration, with their true state and gain."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import LinkFeatures, link_numbers, link_states
from sionna_partial.prediction.link_context import LinkContext


@dataclass(frozen=True, eq=False)
class LinkTable:
    """N links; a transmitter and a receiver at one stage of exploration of one home are a link.

    Parameters
    ----------
    home : (N,) str array
        Name of the home, such as "make_home(10003)".
    stage : (N,) float64 array
        Steps that the robot has explored; below 1, the fraction of the home's free area that it was to observe.
    phi : LinkFeatures
        Features of the trace on the partial map, with their context.
    link_state, gain_db : (N,) arrays
        LinkState and omnidirectional path gain [dB] on the complete map; a receiver that is not inside is in outage
        (paper, "Indoor-Outdoor Estimation").
    inside, anywhere : (N,) bool arrays
        Whether the receiver is in a free cell of the complete map, and whether it was drawn from the whole map area
        rather than from those.
    observed_fraction : (N,) float64 array
        Fraction of the home's free area that the robot has seen.
    complete_maps : mapping of str to PartialMap
        The complete homes by name.
    """

    home: NDArray[np.str_]
    stage: NDArray[np.float64]
    phi: LinkFeatures
    link_state: NDArray[np.uint8]
    gain_db: NDArray[np.float64]
    inside: NDArray[np.bool_]
    anywhere: NDArray[np.bool_]
    observed_fraction: NDArray[np.float64]
    complete_maps: Mapping[str, PartialMap]

    def __post_init__(self) -> None:
        if self.phi.context is None:
            raise PredictorError("phi has no context: give the LinkFeatures of link_features.")
        link_states("link_state", self.link_state, len(self))
        link_numbers("gain_db", self.gain_db, len(self))

    def __len__(self) -> int:
        """Return the number of links N."""
        return len(self.home)

    @property
    def context(self) -> LinkContext:
        """Positions of the links, and their maps."""
        assert self.phi.context is not None
        return self.phi.context

    def take(self, index: NDArray[np.generic] | slice) -> "LinkTable":
        """Return the links that an index array, a mask (N,) or a slice selects."""
        phi = self.phi.take(index)
        columns = {name: getattr(self, name)[index] for name in COLUMNS}
        return LinkTable(phi=phi, complete_maps=self.complete_maps, **columns)

    @classmethod
    def concatenate(cls, parts: Iterable["LinkTable"]) -> "LinkTable":
        """Return the links of all `parts`, one part after the other."""
        tables = list(parts)
        if not tables:
            raise PredictorError("parts is empty: give at least one LinkTable.")
        phi = LinkFeatures.concatenate([table.phi for table in tables])
        columns = {name: np.concatenate([getattr(table, name) for table in tables]) for name in COLUMNS}
        complete_maps = {name: home for table in tables for name, home in table.complete_maps.items()}
        return cls(phi=phi, complete_maps=complete_maps, **columns)


def stage_name(stage: float) -> str:
    """Return the name of a stage: "50 steps", or "25 % observed"."""
    return f"{stage:g} steps" if stage >= 1 or stage == 0 else f"{100 * stage:g} % observed"


COLUMNS = ("home", "stage", "link_state", "gain_db", "inside", "anywhere", "observed_fraction")
"""Names of the columns beside the features."""
