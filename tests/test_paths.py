"""Lists of paths: their order when they are joined."""

import numpy as np

from sionna_partial.tracing.paths import SolvedPaths, join_paths


def _paths(*rows: tuple[int, int, float, complex]) -> SolvedPaths:
    """Paths of (transmitter, receiver, delay [s], gain), each with a gain of its own."""
    tx, rx, delay_s, a = (np.array(column) for column in zip(*rows, strict=True))
    count = len(rows)
    return SolvedPaths(
        path_tx=tx.astype(np.int32),
        path_rx=rx.astype(np.int32),
        transfer=a.astype(np.complex128)[:, None, None],
        delay_s=delay_s.astype(np.float64),
        departure_rad=np.zeros((count, 2)),
        arrival_rad=np.zeros((count, 2)),
        interactions=np.full((count, 1), 1, np.uint8),
        vertices_m=np.zeros((count, 1, 3), np.float32),
    )


def test_ties_keep_their_order() -> None:
    parts = [_paths((0, 1, 1e-8, 1), (0, 1, 1e-8, 2)), _paths((0, 0, 1e-8, 3)), _paths((0, 1, 1e-8, 4))]
    assert join_paths(parts, 1).a.tolist() == [3, 1, 2, 4]


def test_many_links_keep_the_order_of_their_delays() -> None:
    """Transmitter, receiver and delay are packed into one number: none of them may spill into another."""
    for tx, rx in ((999, 999_999), (0, 2**31 - 1)):
        rows = [(tx, rx, 1e-3, 1), (tx, 0, 1.0, 2), (0, rx, 1.0, 3), (0, 0, 0.0, 4), (tx, rx, 1e-9, 5)]
        assert join_paths([_paths(*rows)], 1).a.real.tolist() == [row[3] for row in sorted(rows)]
