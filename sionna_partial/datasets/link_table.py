"""Links of many homes at several stages of exploration, with their true state and gain."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.display import Shown
from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import LinkContext, LinkFeatures, link_numbers, link_states


@dataclass(frozen=True, eq=False)
class LinkTable(Shown):
    """N links; a transmitter and a receiver at one stage of exploration of one home are a link.

    Parameters
    ----------
    home : (N,) str array
        Name of the home, such as "make_home(10003)".
    stage : (N,) float64 array
        Steps that the robot has explored; below 1, the fraction of the home's free area that it was to observe.
    features : LinkFeatures
        Features of the trace on the partial map, with their context.
    maps : tuple of M PartialMap
        The partial maps.
    map_index : (N,) int64 array
        Index of each link's map.
    link_state, gain_db : (N,) arrays
        LinkState and omnidirectional path gain [dB] on the complete map; a receiver that is not inside is in outage
        (paper, "Indoor-Outdoor Estimation").
    inside, anywhere : (N,) bool arrays
        True for a receiver in a free cell of the complete map, and for one that was drawn from the whole map area.
    observed_fraction : (N,) float64 array
        Fraction of the home's free area that the robot has seen.
    complete_maps : mapping of str to PartialMap
        The complete homes by name.
    """

    home: NDArray[np.str_]
    stage: Floats
    features: LinkFeatures
    maps: tuple[PartialMap, ...]
    map_index: NDArray[np.int64]
    link_state: States
    gain_db: Floats
    inside: Bools
    anywhere: Bools
    observed_fraction: Floats
    complete_maps: Mapping[str, PartialMap]

    def __post_init__(self) -> None:
        if self.features.context is None:
            raise PredictorError("features has no context: give the LinkFeatures of link_features.")
        link_states("link_state", self.link_state, (len(self),))
        link_numbers("gain_db", self.gain_db, (len(self),))

    def __len__(self) -> int:
        """Return the number of links N."""
        return len(self.home)

    @property
    def context(self) -> LinkContext:
        """Features of the links that derive from the maps."""
        assert self.features.context is not None
        return self.features.context

    @cached_property
    def phi(self) -> LinkFeatures:
        """The features with the windows that map networks read, which are drawn at the first access."""
        return self.features.with_windows(self.maps, self.map_index)

    def take(self, index: NDArray[np.generic] | slice) -> "LinkTable":
        """Return the links that an index array, a mask (N,) or a slice selects."""
        features = self.__dict__.get("phi", self.features).take(index)  # with the windows, if they were drawn
        columns = {name: getattr(self, name)[index] for name in (*COLUMNS, "map_index")}
        return LinkTable(features=features, maps=self.maps, complete_maps=self.complete_maps, **columns)

    @classmethod
    def concatenate(cls, parts: Iterable["LinkTable"]) -> "LinkTable":
        """Return the links of all `parts`, one part after the other."""
        tables = list(parts)
        if not tables:
            raise PredictorError("parts is empty: give at least one LinkTable.")
        features = LinkFeatures.concatenate([table.features for table in tables])
        columns = {name: np.concatenate([getattr(table, name) for table in tables]) for name in COLUMNS}
        complete_maps = {name: home for table in tables for name, home in table.complete_maps.items()}
        maps = {id(each): each for table in tables for each in table.maps}
        number = {key: index for index, key in enumerate(maps)}
        numbers = [np.array([number[id(each)] for each in table.maps], dtype=np.int64) for table in tables]
        index = np.concatenate([each[table.map_index] for each, table in zip(numbers, tables, strict=True)])
        return cls(
            features=features, maps=tuple(maps.values()), map_index=index, complete_maps=complete_maps, **columns
        )


def stage_name(stage: float) -> str:
    """Return the name of a stage: "50 steps", or "25 % observed"."""
    return f"{stage:g} steps" if stage >= 1 or stage == 0 else f"{100 * stage:g} % observed"


COLUMNS = ("home", "stage", "link_state", "gain_db", "inside", "anywhere", "observed_fraction")
"""Names of the columns other than the features."""
