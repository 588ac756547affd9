"""Expected walls in unknown space: integrals over lines, what the shipped networks know, and their training."""

import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.errors import PredictorError
from sionna_partial.lab.training.walls import Lines, fit_unseen_walls, lines_of
from sionna_partial.prediction.unseen_walls import (
    CELL_M,
    DISPERSION,
    LONGEST_M,
    WEIGHTS_FILE,
    DirectLines,
    UnseenWalls,
    corrected,
    count_probabilities,
    walls_met,
    walls_per_m,
)

WALLS_PER_M = 0.37
WIFI = sp.TraceSettings(5e9, max_depth=1)


def half_known(width: int = 80) -> sp.PartialMap:
    """A room without an end: what is behind its first 4 m is unknown."""
    state = np.zeros((40, width), dtype=np.uint8)
    state[[0, -1]], state[:, 0] = CellState.WALL, CellState.WALL
    state[:, 40:] = CellState.UNKNOWN
    return sp.PartialMap(state, 0.1, (3.0, -2.0))


@pytest.fixture(scope="module")
def unseen_home() -> list[Lines]:
    """Lines of a home that the shipped networks were not trained on."""
    return lines_of(540_000, None, robot=False)


def test_no_walls_are_expected_in_what_is_known():
    model = sp.LinkModel(half_known(), trace_settings=WIFI)
    phi = model.features((4.0, 0.0, 1.5), [(x, 0.0, 1.5) for x in (6.0, 7.5, 9.0, 10.5)])
    walls = UnseenWalls.shipped().of_map(model.partial).counts(DirectLines.of(phi))
    assert walls[0] == 0.0
    assert (np.diff(walls) > 0.0).all()
    seen = UnseenWalls.shipped().of_map(sp.PartialMap(np.zeros((40, 40), dtype=np.uint8), 0.1))
    first_x, first_y = np.ceil(-seen.origin_m / CELL_M - 1e-6).astype(int)
    assert not np.any(seen.per_m[0, first_y : first_y + 12, first_x : first_x + 12])
    assert np.any(seen.per_m)


def test_turned_maps_have_turned_walls():
    def walls(state, origin_m=(0.0, 0.0)):
        return UnseenWalls.shipped().of_map(sp.PartialMap(state.copy(), 0.1, origin_m)).per_m[0]

    state = np.kron(np.random.default_rng(0).integers(0, 3, (4, 7)), np.ones((9, 9))).astype(np.uint8)
    expected = walls(state)
    np.testing.assert_allclose(walls(state, (3.21, -8.765)), expected, atol=1e-6)
    np.testing.assert_allclose(walls(state[:, ::-1]), expected[:, ::-1], atol=1e-5)
    np.testing.assert_allclose(walls(np.rot90(state)), np.rot90(expected)[..., ::-1], atol=1e-5)
    assert np.ptp(expected) > 0.1


def test_the_number_of_walls_is_negative_binomial():
    """The mean is kept, and the variance is larger than a Poisson distribution's."""
    walls = np.array([0.0, 0.3, 1.0, 3.0, 6.0])
    probabilities = count_probabilities(walls)
    count = np.arange(len(probabilities))[:, None]
    np.testing.assert_allclose(probabilities.sum(axis=0), 1.0)
    np.testing.assert_allclose((count * probabilities).sum(axis=0), walls, atol=2e-3)
    variance = ((count - walls) ** 2 * probabilities).sum(axis=0)
    np.testing.assert_allclose(variance, walls + DISPERSION * walls**2, rtol=5e-3)
    assert probabilities[0, 0] == 1.0


def test_long_lines_have_as_many_walls_on_a_metre_as_the_longest_of_the_training():
    partial = sp.PartialMap(np.full((20, 1040), CellState.UNKNOWN, dtype=np.uint8), 0.2)
    density = UnseenWalls.shipped().of_map(partial)
    model = sp.LinkModel(partial, trace_settings=sp.TraceSettings(5e9, max_depth=0))
    lengths_m = np.array([0.5, 1.0, 2.0, 4.0]) * LONGEST_M
    phi = model.features((5.0, 2.0, 1.5), [(5.0 + length_m, 2.0, 1.5) for length_m in lengths_m])
    per_m = density.counts(DirectLines.of(phi)) / lengths_m
    assert per_m[0] > per_m[1]
    np.testing.assert_allclose(per_m[2:], per_m[1], rtol=0.1)


def test_better_than_as_many_walls_on_every_metre(unseen_home):
    """As many as in other homes."""
    networks, errors, others = UnseenWalls.shipped(), [], []
    for lines in unseen_home:
        pad = [(0, -count % 8) for count in lines.image.shape[:2]]
        per_m = walls_per_m(networks.cells, np.pad(lines.image, [*pad, (0, 0)])[None].astype(np.float32))
        integral = walls_met(per_m, lines.start[None], lines.end[None])[0]
        expected = corrected(networks.lines, integral, lines.unobserved_m, lines.distance_m, lines.known)
        errors.append(np.asarray(expected) - lines.unseen)
        others.append(WALLS_PER_M * lines.unobserved_m - lines.unseen)
    rmse, other = (np.sqrt(np.mean(np.concatenate(each) ** 2)) for each in (errors, others))
    assert rmse < 0.85 * other


def test_damaged_weights(monkeypatch, tmp_path):
    """The package lists the SHA-256: no other bytes are read."""
    path = tmp_path / "unseen_walls.npz"
    monkeypatch.setattr("sionna_partial.prediction.unseen_walls.WEIGHTS_FILE", path)
    with pytest.raises(PredictorError, match=r"unseen_walls\.npz' cannot be read"):
        UnseenWalls.shipped.__wrapped__(UnseenWalls)
    path.write_bytes(WEIGHTS_FILE.read_bytes()[:-1])
    with pytest.raises(PredictorError, match=r"unseen_walls\.npz' has SHA-256 .* was changed; install"):
        UnseenWalls.shipped.__wrapped__(UnseenWalls)


def test_training_repeats_itself(unseen_home, tmp_path, monkeypatch):
    """Shown for networks of few layers, of which TensorFlow makes graphs faster."""
    monkeypatch.setattr("sionna_partial.lab.training.walls.IMAGES", 2)
    monkeypatch.setattr("sionna_partial.prediction.unseen_walls._WIDTHS", (8, 8))
    first, second = (fit_unseen_walls(unseen_home[:2], steps=2) for _ in range(2))
    first.save(tmp_path / "first.npz")
    start = UnseenWalls.untrained().cells.get_weights()[0]
    for one, other in zip(first, second, strict=True):
        assert all(np.array_equal(*pair) for pair in zip(one.get_weights(), other.get_weights(), strict=True))
    assert not np.array_equal(first.cells.get_weights()[0], start)
    with np.load(tmp_path / "first.npz") as stored:
        assert np.array_equal(stored["cells_0"], first.cells.get_weights()[0])


def test_a_map_is_read_once(monkeypatch: pytest.MonkeyPatch):
    read, of_map = [], UnseenWalls.of_map
    monkeypatch.setattr(UnseenWalls, "of_map", lambda walls, partial: read.append(partial) or of_map(walls, partial))
    settings, far = sp.TraceSettings(5e9, max_depth=0, diffraction=False), [(8.5, 0.0, 1.5)]
    first, other = half_known(), half_known(60)
    for partial in (first, first, other):
        sp.LinkModel(partial, trace_settings=settings).predict((4.0, 0.0, 1.5), far)
    assert list(map(id, read)) == [id(first), id(other)]
