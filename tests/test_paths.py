"""Lists of paths: their order when they are joined, and the angles at both ends."""

import dataclasses

import numpy as np
import pytest

from sionna_partial.tracing.paths import PathColumns, SolvedPaths, join_paths


def _paths(*rows: tuple[int, int, float, complex], depth: int = 1) -> SolvedPaths:
    """Paths of (transmitter, receiver, delay [s], gain), each with a gain of its own."""
    tx, rx, delay_s, a = (np.array(column) for column in zip(*rows, strict=True)) if rows else [np.zeros(0)] * 4
    count = len(rows)
    return SolvedPaths(
        path_tx=tx.astype(np.int32),
        path_rx=rx.astype(np.int32),
        transfer=a.astype(np.complex128)[:, None, None],
        delay_s=delay_s.astype(np.float64),
        departure_rad=np.stack([a.real, -a.real], axis=1).astype(float),
        arrival_rad=np.stack([2 * a.real, -2 * a.real], axis=1).astype(float),
        interactions=np.full((count, depth), 1, np.uint8),
        vertices_m=np.broadcast_to(a.real[:, None, None], (count, depth, 3)).astype(np.float32),
    )


class TestPathColumns:
    def test_what_is_added_later_stands_later(self) -> None:
        columns = PathColumns(2)
        columns.append([_paths((0, 5, 2e-8, 1), (0, 4, 1e-8, 2))])
        columns.append([])
        columns.append([_paths((0, 1, 1e-8, 3), depth=2), _paths((0, 0, 1e-8, 4))])
        paths = columns.paths()
        assert paths.a.tolist() == [2, 1, 4, 3]
        assert paths.vertices_m.shape == (4, 2, 3)
        assert np.isnan(paths.vertices_m[:3, 1]).all()

    def test_between_names_both_ends(self) -> None:
        paths = _paths((0, 5, 2e-8, 1), (0, 4, 1e-8, 2)).between(3, np.arange(100, 110, dtype=np.int32))
        assert paths.path_tx.tolist() == [3, 3]
        assert paths.path_rx.tolist() == [105, 104]
        assert paths.path_tx.dtype == paths.path_rx.dtype == np.int32


class TestJoinPaths:
    def test_orders_by_transmitter_then_receiver_then_delay(self) -> None:
        first = _paths((1, 0, 1e-8, 1), (0, 2, 3e-8, 2), (0, 2, 1e-8, 3))
        second = _paths((0, 0, 9e-8, 4), (1, 0, 5e-9, 5), (0, 2, 2e-8, 6))
        joined = join_paths([first, second], 1)
        assert joined.a.tolist() == [4, 3, 6, 2, 5, 1]
        assert joined.path_tx.tolist() == [0, 0, 0, 0, 1, 1]
        assert joined.path_rx.tolist() == [0, 2, 2, 2, 0, 0]
        assert joined.delay_s.tolist() == [9e-8, 1e-8, 2e-8, 3e-8, 5e-9, 1e-8]

    def test_every_field_moves_with_its_path(self) -> None:
        rng = np.random.default_rng(0)
        rows = [(int(rng.integers(3)), int(rng.integers(4)), float(rng.uniform(1e-9, 1e-6)), k + 1) for k in range(60)]
        joined = join_paths([_paths(*rows[:20]), _paths(*rows[20:25], depth=3), _paths(*rows[25:], depth=2)], 3)
        assert joined.a.real.tolist() == [row[3] for row in sorted(rows)]
        gain = joined.a.real
        np.testing.assert_array_equal(joined.departure_rad, np.stack([gain, -gain], axis=1))
        np.testing.assert_array_equal(joined.arrival_rad, np.stack([2 * gain, -2 * gain], axis=1))
        depth = np.select([gain <= 20, gain <= 25], [1, 3], 2)
        used = np.arange(3) < depth[:, None]
        np.testing.assert_array_equal(joined.interactions, used)
        np.testing.assert_array_equal(joined.vertices_m[used], np.repeat(gain, depth)[:, None].repeat(3, axis=1))
        assert np.isnan(joined.vertices_m[~used]).all()

    def test_ties_keep_their_order(self) -> None:
        parts = [_paths((0, 1, 1e-8, 1), (0, 1, 1e-8, 2)), _paths((0, 0, 1e-8, 3)), _paths((0, 1, 1e-8, 4))]
        assert join_paths(parts, 1).a.tolist() == [3, 1, 2, 4]

    def test_many_links_keep_the_order_of_their_delays(self) -> None:
        """Transmitter, receiver and delay are packed into one number: none of them may spill into another."""
        for tx, rx in ((999, 999_999), (0, 2**31 - 1)):
            rows = [(tx, rx, 1e-3, 1), (tx, 0, 1.0, 2), (0, rx, 1.0, 3), (0, 0, 0.0, 4), (tx, rx, 1e-9, 5)]
            assert join_paths([_paths(*rows)], 1).a.real.tolist() == [row[3] for row in sorted(rows)]

    @pytest.mark.parametrize("parts", [[], [_paths()], [_paths(), _paths(depth=2)]], ids=["none", "one", "two"])
    @pytest.mark.parametrize(("max_depth", "depth"), [(0, 1), (1, 1), (6, 6)])
    def test_no_paths(self, parts: list[SolvedPaths], max_depth: int, depth: int) -> None:
        joined = join_paths([part for part in parts if part.interactions.shape[1] <= depth], max_depth)
        shapes = {field.name: getattr(joined, field.name).shape for field in dataclasses.fields(joined)}
        assert {shapes[name] for name in ("path_tx", "path_rx", "delay_s")} == {(0,)}
        assert shapes["transfer"] == (0, 1, 1)
        assert shapes["departure_rad"] == shapes["arrival_rad"] == (0, 2)
        assert shapes["interactions"] == (0, depth)
        assert shapes["vertices_m"] == (0, depth, 3)


class TestOfVertices:
    TX = np.array([1.0, 2.0, 1.5])
    RX = np.array([[4.0, 6.0, 1.5], [1.0, 2.0, 2.5]])

    def _make(self, path_rx: list[int], interactions: list[list[int]], vertices_m: object) -> SolvedPaths:
        count = len(path_rx)
        return SolvedPaths.of_vertices(
            path_rx=np.array(path_rx, np.int32),
            transfer=np.ones((count, 1, 1), np.complex128),
            delay_s=np.ones(count),
            interactions=np.array(interactions, np.uint8).reshape(count, 2),
            vertices_m=np.array(vertices_m, np.float32).reshape(count, 2, 3),
            tx_m=self.TX,
            rx_m=self.RX,
        )

    def test_line_of_sight_points_at_the_other_end(self) -> None:
        paths = self._make([0, 1], [[0, 0], [0, 0]], np.full((2, 2, 3), 99.0))
        np.testing.assert_allclose(paths.departure_rad, [[np.pi / 2, np.arctan2(4, 3)], [0.0, 0.0]])
        np.testing.assert_allclose(paths.arrival_rad, [[np.pi / 2, np.arctan2(-4, -3)], [np.pi, 0.0]])
        assert np.isnan(paths.vertices_m).all()
        assert paths.path_tx.tolist() == [0, 0]

    def test_reflections_point_at_the_first_and_from_the_last(self) -> None:
        below, beside = [1.0, 3.0, 0.5], [4.0, 5.0, 2.5]
        paths = self._make([0, 0], [[1, 0], [1, 8]], [[below, [7, 7, 7]], [below, beside]])
        np.testing.assert_allclose(paths.departure_rad, [[0.75 * np.pi, np.pi / 2]] * 2, rtol=1e-6)
        to_below = np.array(below) - self.RX[0]
        zenith = np.arctan2(np.hypot(*to_below[:2]), to_below[2])
        expected = [[zenith, np.arctan2(to_below[1], to_below[0])], [np.pi / 4, -np.pi / 2]]
        np.testing.assert_allclose(paths.arrival_rad, expected, rtol=1e-6)
        assert np.isnan(paths.vertices_m).all(axis=2).tolist() == [[False, True], [False, False]]

    def test_no_paths(self) -> None:
        paths = self._make([], [], [])
        assert paths.departure_rad.shape == paths.arrival_rad.shape == (0, 2)
        assert paths.vertices_m.shape == (0, 2, 3)
