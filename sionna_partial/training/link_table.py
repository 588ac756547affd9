"""Links of many homes at several stages of exploration, with what is true of them: what a predictor learns from."""

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from sionna_partial.errors import PredictorError
from sionna_partial.learning.features import LinkFeatures


@dataclass(frozen=True, eq=False)
class LinkTable:
    """N links; a transmitter and a receiver at one stage of exploration of one home are a link.

    Parameters
    ----------
    home : (N,) str array
        Name of the home, such as "make_home(10003)".
    stage : (N,) int64 array
        Steps that the robot has explored.
    tx_m, rx_m : (N, 3) float64 arrays
        Positions of transmitter and receiver [m].
    phi : LinkFeatures
        Features of the trace on the partial map.
    link_state : (N,) uint8 array of LinkState
        Link state on the complete map; a receiver that is not inside is in outage (paper, "Indoor-Outdoor Estimation").
    gain_db : (N,) float64 array
        Omnidirectional path gain on the complete map [dB].
    inside : (N,) bool array
        Whether the receiver is in a free cell of the complete map.
    anywhere : (N,) bool array
        Whether the receiver was drawn from the whole map area rather than from the free cells of the complete map.
    tx_seen, rx_seen : (N,) bool arrays
        Whether the transmitter, the receiver is in an observed cell of the partial map.
    observed_fraction : (N,) float64 array
        Share of the home's free area that the robot has seen.
    """

    home: NDArray[np.str_]
    stage: NDArray[np.int64]
    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    phi: LinkFeatures
    link_state: NDArray[np.uint8]
    gain_db: NDArray[np.float64]
    inside: NDArray[np.bool_]
    anywhere: NDArray[np.bool_]
    tx_seen: NDArray[np.bool_]
    rx_seen: NDArray[np.bool_]
    observed_fraction: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of links N."""
        return len(self.home)

    def take(self, index: NDArray[np.generic] | slice) -> "LinkTable":
        """Return the links that an index array, a mask (N,) or a slice selects."""
        phi = self.phi.take(index)
        columns = {name: getattr(self, name)[index] for name in COLUMNS}
        return LinkTable(phi=phi, **columns)

    @classmethod
    def concatenate(cls, parts: Iterable["LinkTable"]) -> "LinkTable":
        """Return the links of all `parts`, one part after the other.

        Raises
        ------
        PredictorError
            If there is no part.
        """
        tables = list(parts)
        if not tables:
            raise PredictorError("parts is empty: give at least one LinkTable.")
        phi = LinkFeatures.concatenate([table.phi for table in tables])
        columns = {name: np.concatenate([getattr(table, name) for table in tables]) for name in COLUMNS}
        return cls(phi=phi, **columns)


COLUMNS = tuple(field.name for field in fields(LinkTable) if field.name != "phi")
"""Names of the columns beside the features."""
