"""Materials of the power of candidates hold for what Sionna RT finds, and what is left out changes no link."""

import numpy as np
import pytest
from extruded import ROOM, SPLINTERS, drawn, drywall, extrude, room_of

import sionna_partial as sp
from sionna_partial.checks import no_progress
from sionna_partial.constants import LinkState
from sionna_partial.scene.scene import write_scene
from sionna_partial.tracing.engine import SceneSolver
from sionna_partial.tracing.plan.edges import DiffractionCandidates, find_wedges
from sionna_partial.tracing.plan.reflections import SpecularCandidates
from sionna_partial.tracing.power import (
    VERTICAL,
    at_edge,
    at_wall,
    materials_of,
    most_at_edge,
    reflection_coefficients,
    utd_terms,
    wedge_angle,
    wedge_constants,
)
from sionna_partial.tracing.select import LEVELS, Listed, Selection, missing_power

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


class TestDiffraction:
    def test_the_rough_bound_is_no_less(self) -> None:
        rng, terms, exterior = np.random.default_rng(3), np.empty((4, 3)), 1.7 * np.pi
        table, wedge = materials_of([DRYWALL], 28e9), wedge_constants(np.array([exterior]))[0]
        for arrival, departure in rng.uniform(0.0, exterior, (300, 2)):
            utd_terms(wedge, wedge_angle(arrival, exterior), wedge_angle(departure, exterior), terms)
            for boundary in (1.0, 10.0, 100.0):
                level = 1.0, 0.0, VERTICAL
                exact = at_edge((table.reflection, table.transition), 0, terms, boundary, (-1.0, -1.0), *level)
                assert exact.vertical <= 1.03 * most_at_edge(terms, boundary, 1.0, 1.0)

    def test_a_wall_that_is_grazed_has_a_finite_bound(self) -> None:
        """Rounding must not take the root of a negative number: the bound of a whole link would be NaN."""
        table, terms = materials_of([DRYWALL], 28e9), np.ones((4, 3))
        for sine in np.linspace(0.01, 0.99, 500):
            level = float(sine), float(np.sqrt(1.0 - sine**2)), VERTICAL
            assert np.isfinite(at_edge((table.reflection, table.transition), 0, terms, 10.0, (0.0, -1.0), *level)).all()
            assert np.isfinite(at_wall(table.largest, 0, 0.0, *level)).all()


class TestLevels:
    def test_needed_levels(self) -> None:
        power = np.random.default_rng(1).uniform(0.0, 1.0, (50, LEVELS)) ** 8
        allowed = np.random.default_rng(2).uniform(0.0, 5.0, 50)
        needed = Selection([], power).needed(allowed / 0.25, 10.0 * np.log10(1.25))
        for row, count, most in zip(power, needed, allowed, strict=True):
            assert row[count:].sum() <= most
            assert count == 1 or row[count - 1 :].sum() > most
        assert missing_power(np.array([0.0, 1e-8]), 0.1) == pytest.approx([1e-15, 1e-8 * (10**0.01 - 1)], abs=0.0)


def test_no_path_is_stronger_than_the_bound_of_its_candidate(tmp_path) -> None:
    """Sum of |a|^2 over all paths of a link, against the sum of all bounds."""
    geometry = extrude(np.concatenate([ROOM, SPLINTERS]))
    tx, rx = np.array([1.07, 1.93, 1.2]), np.array([[4.5, 0.7, 2.1], [5.2, 3.1, 0.4], [2.2, 3.4, 1.2]])
    room, wedges = room_of(geometry, tx, rx), find_wedges(geometry, open_ends=False)
    solver = SceneSolver(write_scene(geometry, tmp_path, offset_m=(0.0, 0.0)), geometry.shapes, sp.TraceSettings())
    reflected = SpecularCandidates(geometry, room, 4, drywall())
    for candidates in (reflected, DiffractionCandidates(geometry, wedges, room, 3, drywall())):
        found, bound = np.zeros(len(rx)), np.zeros(len(rx))
        for part in candidates.listed(np.zeros(len(rx))):
            paths, _ = solver.verify(part.write(np.flatnonzero(np.isfinite(part.bound))), tx, rx)
            found += np.bincount(paths.path_rx, np.abs(paths.a) ** 2, len(rx))
            bound += np.bincount(part.rx, np.where(np.isfinite(part.bound), part.bound, 0.0), len(rx))
        assert (found <= bound * (1 + 1e-3)).all()
        assert (found > 0).all()


def test_what_is_left_out_changes_power_and_states_by_no_more_than_the_tolerance() -> None:
    tolerance_db = 0.1
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
    model = sp.LinkModel(plan)
    amplified = sum(len(paths.a) for paths in model.simulation.blocks(np.array(tx), np.array(rx), no_progress))
    assert amplified < 0.5 * len(some.a)
    gain_db = model.features(tx, rx).gain_db
    assert np.abs(every.gain_db - gain_db).max() <= 0.5 * tolerance_db


@pytest.mark.parametrize("tolerance_db", [0.0, 0.1])
def test_candidates_without_power_are_never_written(tolerance_db: float) -> None:
    """A bound of 0 marks a line that is no path, whose faces are unknown."""
    written: list[int] = []

    class Lines:
        name = "lines"

        def listed(self, _: np.ndarray):
            yield Listed(np.zeros(4, np.int64), np.array([1e-6, 0.0, 1e-40, 0.0]), written.extend, 1.0)

    found = np.zeros(1)
    selection = Selection.of([Lines()], found, tolerance_db, no_progress)
    for blocks in selection.rounds(np.full(1, 1e-3 if tolerance_db == 0.0 else 0.0), tolerance_db, (0.0, 1.0)):
        list(blocks)
    assert written == ([0, 2] if tolerance_db == 0.0 else [0])
