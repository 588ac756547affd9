import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.differentiable.scene import DifferentiableScene
from sionna_partial.placement import views as placement_views
from sionna_partial.placement.area import PlacementArea, placement_area
from sionna_partial.placement.objective import PlacementObjective
from sionna_partial.placement.views import PlacementViews
from sionna_partial.prediction.predictor import LinkPrediction

SETTINGS = sp.TraceSettings(max_depth=1, diffraction=False)
PLACES_M = np.array([[1.02, 1.13, 1.4], [2.21, 0.93, 1.4]])


def partial_room(*, complete: bool) -> sp.PartialMap:
    """A room with a screen in it; the right part of an incomplete one is unknown."""
    state = np.zeros((42, 72), dtype=np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = sp.CellState.WALL
    state[:22, 36] = sp.CellState.WALL
    if not complete:
        state[:, 50:] = sp.CellState.UNKNOWN
    return sp.PartialMap(state, 0.1)


@pytest.fixture(scope="module")
def model() -> sp.Predictor:
    return sp.Predictor.load()


def build(complete: bool, model: sp.Predictor) -> tuple[DifferentiableScene, PlacementArea]:
    partial = partial_room(complete=complete)
    scene = DifferentiableScene(partial, predictor=model, trace_settings=SETTINGS)
    return scene, placement_area(partial, 1.4, 1.5, None if complete else model)


@pytest.fixture(scope="module", params=[False, True], ids=["partial", "complete"])
def built(request: pytest.FixtureRequest, model: sp.Predictor) -> tuple[DifferentiableScene, PlacementArea]:
    return build(request.param, model)


class TestScores:
    def test_as_traced_and_predicted(
        self, built: tuple[DifferentiableScene, PlacementArea], model: sp.Predictor
    ) -> None:
        scene, area = built
        for objective in (PlacementObjective("coverage", -75.0), PlacementObjective("percentile")):
            expected = []
            for place_m in PLACES_M:
                links = sp.trace_links(scene.partial, place_m, area.rx_m, settings=SETTINGS)
                phi = sp.link_features(scene.partial, links)
                answer = LinkPrediction.of_trace(phi) if scene.partial.is_complete else model.predict(phi)
                expected.append(objective.score(objective.values(answer), area.weight))
            assert np.ptp(expected) > 0.0
            found = PlacementViews(scene, area, objective).scores(PLACES_M)
            np.testing.assert_allclose(found, expected, atol=0.51 * 0.1**objective.digits)
            assert (np.round(found, objective.digits) == found).all()

    def test_nothing_is_traced_twice(
        self, built: tuple[DifferentiableScene, PlacementArea], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        views = PlacementViews(*built, PlacementObjective())
        first = views.scores(PLACES_M)
        monkeypatch.setattr(built[0], "paths", None)
        np.testing.assert_array_equal(views.scores(PLACES_M[::-1]), first[::-1])

    def test_receiver_at_the_transmitter(self, built: tuple[DifferentiableScene, PlacementArea]) -> None:
        scene, area = built
        level = PlacementArea(area.partial, 1.5, area.room, area.rx_m, area.weight, area.spacing_m)
        views = PlacementViews(scene, level, PlacementObjective())
        values = views.values(area.rx_m[[20]] + [[0.005, 0.0, 0.0]])[0]
        assert values[20] == 1.0
        assert len(values) == len(area.rx_m)


class TestSlope:
    @pytest.mark.parametrize("complete", [False, True])
    def test_of_a_soft_coverage(self, complete: bool) -> None:
        """Where no path appears or vanishes the slope is that of the objective; the map network has bends."""
        scene, area = build(complete, sp.Predictor.load("paper"))
        views = PlacementViews(scene, area, PlacementObjective("coverage", -75.0, 6.0))
        step_m, place_m = 0.01, PLACES_M[0]
        moved = place_m + step_m * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
        scores = views.scores(moved)
        expected = np.array([scores[0] - scores[1], scores[2] - scores[3]]) / (2 * step_m)
        slope, beside_m = views.slope(place_m)
        assert beside_m.shape == (0, 3)
        np.testing.assert_allclose(slope, expected, atol=0.02 * np.linalg.norm(expected))

    def test_after_a_look_nothing_is_traced_again(
        self, built: tuple[DifferentiableScene, PlacementArea], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        views = PlacementViews(*built, PlacementObjective(softness_db=6.0))
        anew, _ = views.slope(PLACES_M[0])
        views.scores(PLACES_M)

        def trace(self: PlacementViews, place_m: object) -> None:
            raise AssertionError

        monkeypatch.setattr(placement_views.PlacementViews, "_trace", trace)
        np.testing.assert_array_equal(views.slope(PLACES_M[0])[0], anew)


def test_which_see_the_same(model: sp.Predictor) -> None:
    scene, area = build(True, model)
    views = PlacementViews(scene, area, PlacementObjective())
    assert views.sees_as(PlacementViews(scene, area, PlacementObjective()))
    assert not views.sees_as(PlacementViews(scene, area.thinned(20), PlacementObjective()))
    assert not views.sees_as(PlacementViews(scene, area, PlacementObjective(softness_db=1.0)))
