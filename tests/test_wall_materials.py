"""Walls of an unknown material: candidates on one trace, their prior, and their posterior given powers."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import meshed
from test_crossings import EVERY, flat, rooms

import sionna_partial as sp
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.prediction.features import features_of_paths
from sionna_partial.prediction.map_networks import rule_values
from sionna_partial.prediction.rule import LinkPrediction, predicted
from sionna_partial.prediction.wall_materials import COMMON, P_SAME, RESIDUAL_DB, WallMaterials, with_extra_losses
from sionna_partial.tracing.paths import path_gain_db

WIFI = sp.TraceSettings(2.4e9, max_depth=2, diffraction=False)
EVERY_PATH = sp.TraceSettings(2.4e9, max_depth=2, diffraction=False, power_tolerance_db=0.0)
TX = (1.0, 1.0, 1.5)
OFFSET_DB = -35.0


FLAT = flat()
CONCRETE = sp.Material.named("concrete")
PARTLY_CONCRETE = FLAT.with_wall_material(CONCRETE, [(2.3, -1.0), (2.7, -1.0), (2.7, 9.0), (2.3, 9.0)])
RNG = np.random.default_rng(5)
RX = np.column_stack([RNG.uniform(2.7, 9.4, 120), RNG.uniform(0.4, 3.0, 120), np.full(120, 1.4)])
RX = RX[FLAT.radios_can_stand(RX)]


def model_of(material: str | None, settings: sp.TraceSettings = WIFI, partial: sp.PartialMap = FLAT) -> sp.LinkModel:
    return sp.LinkModel(partial, None, settings, sp.SceneSettings(material=material))


def powers(material: str, rx=RX, tx=TX) -> sp.Measurements:
    """Return powers that a radio measures, with an unknown offset and errors of 2 dB."""
    noise_db = 2.0 * np.random.default_rng(3).standard_normal(len(rx))
    return sp.Measurements(tx, rx, model_of(material).predict(tx, rx).gain_mean_db + OFFSET_DB + noise_db)


class TestCandidates:
    def test_one_trace_has_the_gains_of_any_extra_loss(self):
        extra_db = 12.0, 3.0
        simulation = sp.Simulation(FLAT, EVERY_PATH)
        paths = list(simulation.blocks(np.array(TX), RX, lambda *_: None))
        phi = features_of_paths(FLAT, np.array(TX), RX, paths, simulation.resolved, material_unknown=True)
        power = np.zeros(len(RX))
        for block in paths:
            walls, reflections = ((block.interactions == kind).sum(axis=1) for kind in (4, 1))
            np.add.at(
                power, block.path_rx, block.power * 10.0 ** (-(extra_db[0] * walls + extra_db[1] * reflections) / 10.0)
            )
        assert np.allclose(with_extra_losses(phi, np.full(2, extra_db[0]), extra_db[1]).gain_db, path_gain_db(power))

    @pytest.mark.parametrize("material", ["drywall", "concrete"])
    def test_a_candidate_is_near_the_trace_with_each_material(self, material):
        candidates, _ = model_of(None).predict(TX, RX).by_material
        named = model_of(material).predict(TX, RX).gain_mean_db
        off_db = [np.sqrt(np.mean((each.gain_mean_db - named) ** 2)) for each in candidates]
        assert min(off_db) < 2.5
        assert candidates[int(np.argmin(off_db))].gain_mean_db.mean() == pytest.approx(named.mean(), abs=2.0)

    @pytest.mark.parametrize("frequency_hz", [0.9e9, 60e9])
    def test_prior(self, frequency_hz):
        found = WallMaterials.at(frequency_hz)
        assert found.prior.sum() == pytest.approx(1.0)
        assert len(found.prior) == len(found.crossing_db) == len(found.names) == 16
        assert {*found.names.ravel()} <= {*COMMON}
        assert found.crossing_db.min() + found.traced_db > 0.0
        several = WallMaterials.at(frequency_hz, 2)
        np.testing.assert_allclose(several.prior[:16], found.prior * P_SAME)
        assert several.prior.sum() == pytest.approx(1.0)
        assert np.all(several.crossing_db[16:, 0] != several.crossing_db[16:, 1])


class TestPrediction:
    def test_it_is_the_mixture_over_the_prior_with_residuals(self):
        found = model_of(None).predict(TX, RX)
        parts, weights = found.by_material
        mean_db = sum(weight * part.gain_mean_db for part, weight in zip(parts, weights, strict=True))
        square = sum(weight * part.gain_mean_db**2 for part, weight in zip(parts, weights, strict=True))
        assert np.allclose(found.gain_mean_db, mean_db)
        assert np.allclose(found.gain_std_db**2, square - mean_db**2 + RESIDUAL_DB**2)

    def test_selected_links_keep_their_candidates(self):
        found = model_of(None).predict([TX, (1.2, 2.0, 1.5)], RX[:6])
        assert found.by_material[0][3].gain_mean_db.shape == found.gain_mean_db.shape == (2, 6)
        some = model_of(None).predict(TX, RX[:6]).take(np.arange(4))
        joined = LinkPrediction.concatenate([some.amplified(3.0), some])
        expected = some.by_material[0][1].gain_mean_db
        assert joined.by_material[0][1].gain_mean_db == pytest.approx(np.concatenate([expected + 3.0, expected]))

    def test_a_named_material_has_the_residuals_of_traces(self):
        found = model_of("brick").predict(TX, RX)
        assert np.allclose(found.gain_std_db, RESIDUAL_DB)
        (part,), _ = found.by_material
        assert np.all(part.gain_std_db == 0.0)
        assert np.all(model_of("brick", replace(WIFI, refraction=False)).predict(TX, RX).gain_std_db == 0.0)

    @pytest.mark.parametrize("converted", [lambda partial: partial, lambda partial: meshed(partial, CONCRETE)])
    def test_known_walls_keep_their_material(self, converted):
        """The wall at x = 2.5 m is of concrete, and all others unknown: only they lose more under a candidate."""
        near = RX[RX[:, 0] < 4.7]
        settings = replace(EVERY_PATH, max_depth=0)
        model = model_of(None, settings, converted(PARTLY_CONCRETE))
        parts, _ = model.predict(TX, near).by_material
        named = model_of("concrete", settings).predict(TX, near)
        assert len(parts) == 16
        assert all(np.allclose(part.gain_mean_db, named.gain_mean_db) for part in parts)
        far = RX[RX[:, 0] > 5.2]
        traced_db = model.features(TX, far).gain_db
        lost_db = traced_db - np.array([part.gain_mean_db for part in model.predict(TX, far).by_material[0]])
        walls = (far[:, 0] > 5.0).astype(int) + (far[:, 0] > 7.4)
        expected_db = model.wall_materials.crossing_db[:, :1] * walls
        assert np.allclose(lost_db[:, traced_db > -120.0], expected_db[:, traced_db > -120.0], atol=0.5)

    def test_meshes_and_plans_have_the_same_candidates(self):
        """One wall is of concrete, and others are thin or thick."""
        state = rooms().state.copy()
        state[:, 60:62] = sp.CellState.WALL
        plan = replace(rooms(), state=state)
        plan = plan.with_wall_material(CONCRETE, [(0.9, 2.9), (1.3, 2.9), (1.3, 6.1), (0.9, 6.1)])
        mesh, settings = meshed(plan, CONCRETE), replace(EVERY, wall_depth_m=0.6)
        rx, gains_db = [(2.51, 7.23, 1.3), (5.3, 6.04, 1.5), (1.93, 3.81, 1.7)], []
        for partial in (plan, mesh):
            parts, _ = model_of(None, settings, partial).predict((-0.52, 4.13, 1.5), rx).by_material
            gains_db.append([part.gain_mean_db for part in parts])
        np.testing.assert_allclose(*gains_db, atol=0.05)
        assert len(gains_db[0]) == 28
        assert mesh.unnamed_walls == pytest.approx(plan.unnamed_walls, abs=0.1)
        coverage = sp.predict_map(model_of(None, settings, mesh), (-0.52, 4.13, 1.5), spacing_m=2.0, progress=False)
        assert coverage.attrs["wall_material"] == "drywall .36, brick .36, concrete .28"
        named = replace(mesh, mesh=replace(mesh.mesh, materials=(CONCRETE,) * len(mesh.mesh.materials)))
        assert not sp.Simulation(named, WIFI).material_unknown

    def test_known_materials(self):
        brick = sp.Material.named("brick")
        named = FLAT.with_wall_material(brick, FLAT.state == sp.CellState.WALL)
        for partial in (replace(FLAT, material=brick), named):
            assert not sp.Simulation(partial, WIFI).material_unknown
        for settings in (sp.TraceSettings(28e9), sp.TraceSettings(2.4e9, refraction=False)):
            assert not sp.Simulation(FLAT, settings).material_unknown
        assert sp.Simulation(FLAT, sp.TraceSettings(28e9, refraction=True)).material_unknown

    def test_differentiable_links_have_the_same_distribution(self):
        import tensorflow as tf

        model = model_of(None, replace(EVERY_PATH, max_depth=1))
        links = sp.DifferentiableScene(model).links(TX, RX[:20])
        tx_m, expected = tf.Variable(links.base.tx_m), model.predict(TX, RX[:20])
        with tf.GradientTape() as tape:
            found = links(tx_m=tx_m)
            mean_db = tf.reduce_mean(found.gain_mean_db)
        np.testing.assert_allclose(found.gain_mean_db, expected.gain_mean_db, atol=0.05)
        np.testing.assert_allclose(found.gain_std_db, expected.gain_std_db, atol=0.05)
        assert np.isfinite(tape.gradient(mean_db, tx_m)).all()

    def test_unseen_walls_have_the_loss_of_each_candidate(self):
        state = FLAT.state.copy()
        state[:, 60:] = sp.CellState.UNKNOWN
        far = RX[RX[:, 0] > 6.2]
        parts, _ = model_of(None, partial=sp.PartialMap(state, 0.1)).predict(TX, far).by_material
        means_db = [part.gain_mean_db.mean() for part in parts[:8]]
        assert np.all(np.diff(means_db) < 0.0)
        assert min(part.gain_mean_db.min() for part in parts) >= GAIN_FLOOR_DB

    @pytest.mark.filterwarnings("ignore")
    def test_networks_predict_from_the_trace_and_not_from_a_candidate(self):
        state = FLAT.state.copy()
        state[:, 60:] = sp.CellState.UNKNOWN
        model = sp.LinkModel(sp.PartialMap(state, FLAT.resolution_m), "paper", WIFI)
        phi, found = model.features(TX, RX), model.predict(TX, RX)
        expert, materials = sp.Predictor.load("paper").predict(phi), model.wall_materials
        under = [
            LinkPrediction.of_parts(*predicted(rule_values(each), expert.by_state))
            for each in materials.under(phi, model.partial.unnamed_walls)
        ]
        expected = LinkPrediction.over_materials(under, materials.prior, RESIDUAL_DB)
        assert phi.path_power is not None
        assert np.allclose(found.gain_nlos_mean_db, expected.gain_nlos_mean_db)


class TestMeasurements:
    @pytest.mark.parametrize(("material", "least"), [("drywall", 0.5), ("concrete", 0.8)])
    def test_powers_find_the_material(self, material, least):
        model, measured = model_of(None), powers(material)
        fitted = self.fit(model, measured)
        names = model.wall_materials.names[:, 0]
        found = {name: fitted.material_weights[names == name].sum() for name in COMMON}
        assert max(found, key=found.get) == material, found
        assert found[material] > least
        assert fitted.offset_db == pytest.approx(OFFSET_DB, abs=6.0)

    def test_few_powers_predict_the_others(self):
        model, measured = model_of(None), powers("concrete")
        given, rest = np.arange(8), np.arange(8, len(RX))
        fitted = self.fit(model, measured.take(given))
        after = fitted.update(RX[rest], model.predict(TX, RX[rest]))
        off_db = after.gain_mean_db + fitted.offset_db - measured.gain_db[rest]
        assert np.mean(np.abs(off_db) < 1.645 * after.gain_std_db) > 0.8
        drywall = model_of("drywall")
        simple = self.fit(drywall, measured.take(given))
        simple_db = simple.update(RX[rest], drywall.predict(TX, RX[rest])).gain_mean_db + simple.offset_db
        assert np.mean(off_db**2) < np.mean((simple_db - measured.gain_db[rest]) ** 2)

    def test_thin_and_thick_walls_have_materials_of_their_own(self):
        state = FLAT.state.copy()
        state[:, [24, 72]] = sp.CellState.FREE
        partial = sp.PartialMap(state, 0.1)
        model, rx = model_of(None, partial=partial), RX[partial.radios_can_stand(RX)]
        truth = partial.with_wall_material(CONCRETE, partial.thick_walls)
        gain_db = model_of("drywall", partial=truth).predict(TX, rx).gain_mean_db
        fitted = self.fit(model, sp.Measurements(TX, rx, gain_db + OFFSET_DB))
        text = model.wall_materials.text(fitted.material_weights)
        thin, thick = text.split("; thick walls ")
        assert "drywall" in thin
        assert thick.startswith("concrete")

    def test_maps_say_what_the_walls_are(self):
        model, options = model_of(None), {"spacing_m": 1.0, "progress": False}
        before = sp.predict_map(model, TX, **options)
        after = sp.predict_map(model, TX, measurements=powers("concrete"), **options)
        both = sp.predict_map(model, {"a": TX, "b": (8.8, 2.5, 1.5)}, measurements=powers("concrete"), **options)
        assert after.attrs["wall_material"].startswith("concrete")
        assert both.attrs["wall_material"].startswith("concrete")
        assert after.attrs["wall_loss_db"] > before.attrs["wall_loss_db"] > 3.0
        assert after.gain_std_db.mean() < before.gain_std_db.mean()
        assert "wall_material" not in sp.predict_map(model_of("brick"), TX, **options).attrs

    @staticmethod
    def fit(model, measured, tx=TX, others=()):
        prior = model.predict(tx, measured.rx)
        options = {"frequency_hz": 2.4e9, "through_walls": True, "others": others}
        return Assimilation.fit(FLAT, tx, measured, prior, **options)
