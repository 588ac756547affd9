"""Links of homes at stages of exploration, on their partial maps and on the complete homes."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.display import Shown
from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import LinkContext, LinkFeatures, link_numbers, link_states

COLUMNS = ("home", "stage", "link_state", "gain_db", "inside", "anywhere", "observed_fraction")

CIR = ("path_gain_re", "path_gain_im", "path_delay_s")
"""Impulse response between isotropic antennas on the complete map, the strongest path first.

Complex baseband gain [1], 0 without path, and absolute delay [s], NaN without path.
"""


@dataclass(frozen=True, eq=False)
class LinkTable(Shown):
    """N links, each at one stage of exploration of a home.

    Parameters
    ----------
    home : (N,) str array
        Name of the home, such as "make_home(10003)".
    stage : (N,) float64 array
        Steps of exploration; below 1, the wanted observed fraction of the home's free area.
    features : LinkFeatures
        Features on the partial map.
    maps : tuple of M PartialMap
        The partial maps.
    map_index : (N,) int64 array
        Index of each link's map.
    link_state, gain_db : (N,) arrays
        LinkState and omnidirectional path gain [dB] on the complete map; outage for a receiver that is not inside.
    inside, anywhere : (N,) bool arrays
        True for a receiver in a free cell of the complete map, and for a receiver drawn from the whole map area.
    observed_fraction : (N,) float64 array
        Observed fraction of the home's free area.
    complete_maps : mapping of str to PartialMap
        The complete homes by name.
    cir : mapping of str to (N, cir_paths) float32 array
        `CIR`, if the data set has impulse responses.
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
    cir: Mapping[str, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.features.context is None:
            raise PredictorError("features has no context: give the LinkFeatures of link_features.")
        link_states("link_state", self.link_state, (len(self),))
        link_numbers("gain_db", self.gain_db, (len(self),))

    def __len__(self) -> int:
        return len(self.home)

    @property
    def context(self) -> LinkContext:
        """Context of the links' features."""
        assert self.features.context is not None
        return self.features.context

    @property
    def phi(self) -> LinkFeatures:
        """The features."""
        return self.features

    def take(self, index: NDArray[np.generic] | slice) -> "LinkTable":
        """Select links."""
        features = self.features.take(index)
        columns = {name: getattr(self, name)[index] for name in (*COLUMNS, "map_index")}
        cir = {name: values[index] for name, values in self.cir.items()}
        return LinkTable(features=features, maps=self.maps, complete_maps=self.complete_maps, cir=cir, **columns)

    @classmethod
    def concatenate(cls, parts: Iterable["LinkTable"]) -> "LinkTable":
        """Join links, with impulse responses if all have as many paths."""
        tables = list(parts)
        if not tables:
            raise PredictorError("parts is empty: give at least one LinkTable.")
        features = LinkFeatures.concatenate([table.features for table in tables])
        columns: dict[str, Any] = {name: np.concatenate([getattr(table, name) for table in tables]) for name in COLUMNS}
        complete_maps = {name: home for table in tables for name, home in table.complete_maps.items()}
        maps = {id(each): each for table in tables for each in table.maps}
        number = {key: index for index, key in enumerate(maps)}
        numbers = [np.array([number[id(each)] for each in table.maps], dtype=np.int64) for table in tables]
        index = np.concatenate([each[table.map_index] for each, table in zip(numbers, tables, strict=True)])
        is_same = len({tuple(values.shape[1:] for values in table.cir.values()) for table in tables}) == 1
        cir = {name: np.concatenate([table.cir[name] for table in tables]) for name in tables[0].cir if is_same}
        shared: dict[str, Any] = {
            "maps": tuple(maps.values()),
            "map_index": index,
            "complete_maps": complete_maps,
            "cir": cir,
        }
        return cls(features=features, **shared, **columns)


def stage_name(stage: float) -> str:
    return f"{stage:g} steps" if stage >= 1 or stage == 0 else f"{100 * stage:g} % observed"
