"""Materials of the power of candidates hold for what Sionna RT finds, and what is left out changes no link."""

import numpy as np
import pytest
from extruded import ROOM, SPLINTERS, drawn, extrude

import sionna_partial as sp
from sionna_partial.constants import LinkState
from sionna_partial.tracing.power import (
    at_edge,
    at_wall,
    materials_of,
    most_at_edge,
    reflection_coefficients,
    utd_term,
    utd_terms,
    wedge_angle,
    wedge_constants,
)
from sionna_partial.tracing.select import LEVELS, Selection, levels_of, missing_power

DRYWALL = np.array([2.94, 0.1226, 0.1])


def _indirect_power(links: sp.TracedLinks) -> np.ndarray:
    indirect = (links.interactions > 0).any(axis=1)
    return np.bincount(links.path_rx[indirect], np.abs(links.a[indirect]) ** 2, len(links.rx))


class TestReflection:
    @pytest.mark.parametrize("slab", [DRYWALL, DRYWALL * [1.0, 0.0, 1.0]], ids=["drywall", "without loss"])
    def test_no_angle_reflects_more_than_its_bound(self, slab: np.ndarray) -> None:
        """Without loss, a slab reflects nothing at some angles, and next to them it varies fast."""
        cosine = np.random.default_rng(0).uniform(0.0, 1.0, 20_000)
        table = materials_of([slab], 28e9).largest[0]
        te, tm = reflection_coefficients(*slab, 28e9, cosine)
        bound = table[np.minimum((cosine * len(table)).astype(int), len(table) - 1)]
        found = np.abs([te, tm, te + tm, te]).T
        assert (found <= bound).all()
        assert np.median(bound[:, :3] / np.maximum(found[:, :3], 1e-9), axis=0).max() < 1.05
        assert (np.diff(table[:, 3]) <= 0.0).all()


def _diffracted(arrival: float, departure: float, exterior: float = 1.5 * np.pi, boundary: float = 20.0) -> complex:
    """Sum of the terms of a wedge that absorbs no field and reflects none: the diffracted incident field alone."""
    strengths, terms = materials_of([DRYWALL], 28e9), np.empty((4, 3))
    wedge = wedge_constants(np.array([exterior]))[0]
    utd_terms(wedge, wedge_angle(arrival, exterior), wedge_angle(departure, exterior), terms)
    return sum(utd_term(strengths.transition, terms, k, boundary) for k in (0, 1))


class TestDiffraction:
    def test_at_its_shadow_boundary_a_term_is_half_the_incident_field(self) -> None:
        """That is n sqrt(2 pi kL) / 2 n in either direction, and terms change little next to it."""
        half, step = 0.5 * np.sqrt(np.pi) * 20.0, 1e-6
        for side in (step, -step):
            assert abs(_diffracted(0.7, 0.7 + np.pi + side)) == pytest.approx(half, rel=0.05)

    def test_the_transition_function_is_continuous_where_its_series_takes_over(self) -> None:
        strengths = materials_of([DRYWALL], 28e9)
        term = np.array([[1.0, 1.0, 1.0]])
        inside, outside = (utd_term(strengths.transition, term, 0, y) for y in (3.0 - 1e-9, 3.0 + 1e-9))
        assert inside == pytest.approx(outside, abs=1e-3)

    def test_the_rough_bound_is_no_less(self) -> None:
        rng, terms, exterior = np.random.default_rng(3), np.empty((4, 3)), 1.7 * np.pi
        table, wedge = materials_of([DRYWALL], 28e9), wedge_constants(np.array([exterior]))[0]
        for arrival, departure in rng.uniform(0.0, exterior, (300, 2)):
            utd_terms(wedge, wedge_angle(arrival, exterior), wedge_angle(departure, exterior), terms)
            for boundary in (1.0, 10.0, 100.0):
                level = 1.0, 0.0, (1.0, 0.0, 1.0)
                exact = at_edge((table.reflection, table.transition), 0, terms, boundary, (-1.0, -1.0), *level)
                assert exact[0] <= 1.03 * most_at_edge(terms, boundary, 1.0, 1.0)

    def test_a_wall_that_is_grazed_has_a_finite_bound(self) -> None:
        """Rounding must not take the root of a negative number: the bound of a whole link would be NaN."""
        table, terms = materials_of([DRYWALL], 28e9), np.ones((4, 3))
        for sine in np.linspace(0.01, 0.99, 500):
            level = float(sine), float(np.sqrt(1.0 - sine**2)), (1.0, 0.0, 1.0)
            assert np.isfinite(at_edge((table.reflection, table.transition), 0, terms, 10.0, (0.0, -1.0), *level)).all()
            assert np.isfinite(at_wall(table.largest, 0, 0.0, *level)).all()


class TestLevels:
    def test_levels_fall_with_the_power(self) -> None:
        levels = levels_of(10.0 ** -np.arange(0.0, 25.0, 0.1)).tolist()
        assert levels == sorted(levels)
        assert (levels[0], levels[-1]) == (1, LEVELS - 1)
        assert levels_of(np.array([np.inf, 0.0])).tolist() == [0, LEVELS - 1]

    def test_what_is_beyond_the_needed_levels_is_at_most_what_may_be_missing(self) -> None:
        power = np.random.default_rng(1).uniform(0.0, 1.0, (50, LEVELS)) ** 8
        allowed = np.random.default_rng(2).uniform(0.0, 5.0, 50)
        needed = Selection([], power).needed(allowed / 0.25, 10.0 * np.log10(1.25))
        for row, count, most in zip(power, needed, allowed, strict=True):
            assert row[count:].sum() <= most
            assert count == 1 or row[count - 1 :].sum() > most

    def test_a_link_without_paths_may_miss_what_no_receiver_notices(self) -> None:
        assert missing_power(np.array([0.0, 1e-8]), 0.1) == pytest.approx([1e-15, 1e-8 * (10**0.01 - 1)], abs=0.0)


@pytest.mark.parametrize("walls", [ROOM, np.concatenate([ROOM, SPLINTERS])], ids=["room", "splinters"])
def test_no_path_is_stronger_than_the_bound_of_its_candidate(walls: np.ndarray, tmp_path) -> None:
    """Sum of |a|^2 over all paths of a link, against the sum of all bounds."""
    from extruded import drywall, room_of

    from sionna_partial.scene.scene import write_scene
    from sionna_partial.tracing.engine import SceneSolver
    from sionna_partial.tracing.plan.edges import DiffractionCandidates, find_wedges
    from sionna_partial.tracing.plan.reflections import SpecularCandidates

    geometry = extrude(walls)
    tx, rx = np.array([1.07, 1.93, 1.2]), np.array([[4.5, 0.7, 2.1], [5.2, 3.1, 0.4], [2.2, 3.4, 1.2]])
    room, wedges = room_of(geometry, tx, rx), find_wedges(geometry, open_ends=False)
    solver = SceneSolver(write_scene(geometry, tmp_path, offset_m=(0.0, 0.0)), geometry.shapes, sp.TraceSettings())
    for kind in ("reflected", "diffracted"):
        candidates = (
            SpecularCandidates(geometry, room, 4, drywall())
            if kind == "reflected"
            else DiffractionCandidates(geometry, wedges, room, 3, drywall())
        )
        found, bound = np.zeros(len(rx)), np.zeros(len(rx))
        for part in candidates.listed(np.zeros(len(rx))):
            paths, _ = solver.verify(part.write(np.flatnonzero(np.isfinite(part.bound))), tx, rx)
            found += np.bincount(paths.path_rx, np.abs(paths.a) ** 2, len(rx))
            bound += np.bincount(part.rx, np.where(np.isfinite(part.bound), part.bound, 0.0), len(rx))
        assert (found <= bound * (1 + 1e-3)).all()
        assert (found > 0).all()


@pytest.mark.parametrize("tolerance_db", [0.02, 0.1, 0.5])
def test_what_is_left_out_changes_power_and_states_by_no_more_than_the_tolerance(tolerance_db: float) -> None:
    plan = drawn(
        "############ #..........# #.##..#....# #....#.....# #.#....##..# #..#...#...# #..........# ############", 0.6
    )
    tx, rx = (1.3, 1.2, 1.5), [[x, y, 1.4] for x in (0.9, 2.3, 3.8, 5.2, 6.3) for y in (0.8, 2.1, 3.5, 4.0)]
    rx = [each for each in rx if plan.state_at(np.array([each]))[0] == 0]
    every, some = (
        sp.trace_links(plan, tx, rx, trace_settings=sp.TraceSettings(power_tolerance_db=each))
        for each in (0.0, tolerance_db)
    )
    assert len(some.a) < 0.7 * len(every.a)
    assert some.link_state.tolist() == every.link_state.tolist()
    assert set(every.link_state.tolist()) == {LinkState.LOS, LinkState.NLOS}
    lost_db = 10 * np.log10(_indirect_power(every) / _indirect_power(some))
    assert (lost_db >= -1e-6).all()
    assert lost_db.max() <= tolerance_db
    assert np.abs(every.gain_db - some.gain_db).max() <= tolerance_db
