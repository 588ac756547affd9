"""Sionna RT's image method and field calculator as one step: candidates verified, paths given their coefficients."""

from typing import Any

from sionna_partial.tracing.sionna_rt import load_sionna


class _IncoherentScene:
    """A Mitsuba scene that traces every ray for itself.

    `ImageMethod` tells Embree that its rays are coherent. Neighbours in a packet then decide whether a wall is hit: one
    path in 600 was lost, and which ones depended on the other receivers.
    """

    def __init__(self, scene: Any) -> None:
        self._scene = scene

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scene, name)

    def ray_intersect(self, ray: Any, **options: Any) -> Any:
        return self._scene.ray_intersect(ray, **{**options, "coherent": False})


class Chain:
    """Sionna RT's image method and field calculator, with loops of one kind."""

    def __init__(self, loop_mode: str) -> None:
        solvers = load_sionna().path_solvers
        self._image_method = solvers.image_method.ImageMethod()
        self._field_calculator = solvers.field_calculator.FieldCalculator()
        self._image_method.loop_mode = self._field_calculator.loop_mode = loop_mode

    def __call__(
        self, scene: Any, buffer: Any, source: Any, targets: Any, samples_per_tx: int, diffraction: bool
    ) -> Any:
        """Verify the candidates in a buffer, and give it back with their coefficients."""
        buffer = self.verify(scene, buffer, source, targets, diffraction)
        return self.evaluate(scene, buffer, source, targets, samples_per_tx, diffraction)

    def verify(self, scene: Any, buffer: Any, source: Any, targets: Any, diffraction: bool) -> Any:
        """Verify the candidates in a buffer, and give it back with their vertices."""
        buffer = self._image_method(
            scene=_IncoherentScene(scene.mi_scene),
            paths=buffer,
            src_positions=source,
            tgt_positions=targets,
            diffraction=diffraction,
            diffraction_lit_region=True,
        )
        if diffraction:
            _end_at_targets(buffer, targets)
        return buffer

    def evaluate(
        self, scene: Any, buffer: Any, source: Any, targets: Any, samples_per_tx: int, diffraction: bool
    ) -> Any:
        """Give a buffer of verified candidates back with their coefficients."""
        import drjit as dr
        import mitsuba as mi

        still = dr.zeros(mi.Point3f, dr.width(source)), dr.zeros(mi.Point3f, dr.width(targets))
        dr.make_opaque(*still)
        patterns = scene.tx_array.antenna_pattern.patterns
        return self._field_calculator(
            wavelength=scene.wavelength,
            paths=buffer,
            samples_per_src=samples_per_tx,
            diffraction=diffraction,
            src_positions=source,
            tgt_positions=targets,
            src_orientations=still[0],
            tgt_orientations=still[1],
            src_antenna_patterns=patterns,
            tgt_antenna_patterns=patterns,
        )


def _end_at_targets(buffer: Any, targets: Any) -> None:
    """Put the receiver where a path has no more interactions.

    There `ImageMethod` leaves images of the edge, and `FieldCalculator` 2.2 takes the first of them for a place on the
    way from the edge: a path with fewer interactions than others in its buffer came out longer, and some dB weaker.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.constants import InteractionType

    kind = buffer.interaction_types
    target = dr.gather(mi.Point3f, targets, dr.repeat(buffer.target_indices, kind.shape[1]))
    for name, place in zip(("_vertices_x", "_vertices_y", "_vertices_z"), target, strict=True):
        beyond = dr.select(kind.array == InteractionType.NONE, place, getattr(buffer, name).array)
        setattr(buffer, name, type(getattr(buffer, name))(beyond, kind.shape))
