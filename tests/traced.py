"""Links by hand, without a trace."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.links import TracedLinks


def made_links(tx: ArrayLike, rx: ArrayLike, **columns: Any) -> TracedLinks:
    """Links in outage and without paths, but for what is given."""
    tx, rx = np.asarray(tx, dtype=float), np.asarray(rx, dtype=float).reshape(-1, 3)
    shape, count = (*tx.shape[:-1], len(rx)), len(columns.get("transfer", ()))
    usual = {
        "link_state": np.zeros(shape, dtype=np.uint8),
        "gain_db": np.full(shape, GAIN_FLOOR_DB),
        **{name: np.zeros(count, dtype=np.int32) for name in ("path_tx", "path_rx")},
        "transfer": np.zeros((0, 1, 1), dtype=complex),
        "delay_s": np.zeros(count),
        **{name: np.zeros((count, 2)) for name in ("departure_rad", "arrival_rad")},
        "interactions": np.zeros((count, 1), dtype=np.uint8),
        "vertices_m": np.full((count, 1, 3), np.nan),
    }
    return TracedLinks(tx=tx, rx=rx, trace_settings=TraceSettings(), scene_settings=SceneSettings(), **usual | columns)
