"""Scene folders that stock Sionna RT loads."""

import os
from pathlib import Path

from sionna_partial.constants import CARRIER_FREQUENCY_HZ
from sionna_partial.files import atomic_folder
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.maps.ros_map_writer import write_ros_map
from sionna_partial.scene.scene import scene_settings_of, write_map
from sionna_partial.settings import SceneSettings


def export_scene(
    partial: PartialMap,
    folder: str | os.PathLike[str],
    scene_settings: SceneSettings | None = None,
    *,
    frequency_hz: float = CARRIER_FREQUENCY_HZ,
) -> Path:
    """Write a map as a scene folder that stock Sionna RT loads.

    The folder holds `scene.xml`; the non-empty meshes `meshes/walls.ply`, `walls1.ply` and so on (for
    `wall_materials`), `floor.ply` and `ceiling.ply`, or `part0.ply` and so on for the materials of a mesh; and the map
    as `map.yaml` and `map.pgm`, which `load_map` reads. Scene coordinates are world coordinates minus `scene_offset`
    in `map.yaml`: zero for maps within 1 km of the origin, else the lower-left corner of the map, or whole metres on
    the far axes of a mesh.

    Parameters
    ----------
    partial : PartialMap
    folder : path-like
        New or empty folder, or an exported scene, which is replaced.
    scene_settings : SceneSettings, optional
        Tolerances, floor extent and material.
    frequency_hz : float
        Frequency [Hz] for ITU materials that Sionna RT cannot load by name.

    Raises
    ------
    SettingsError
        For a frequency that the material does not cover.
    OutputError
        If writing fails. No partial scene remains.

    Examples
    --------
    >>> import tempfile, sionna_partial as sp
    >>> home = sp.make_home(3, "apartment")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     scene = sp.export_scene(home, f"{folder}/scene")
    ...     sorted(path.name for path in scene.iterdir()), sp.load_map(scene) == home
    (['map.pgm', 'map.yaml', 'meshes', 'scene.xml'], True)
    """
    require_map("partial", partial)
    settings, environment = scene_settings_of(partial, scene_settings), partial.environment
    offset_m = environment.scene_offset_m(partial.bounds_m)
    for material in environment.known_materials(settings.traced_material):
        material.require_frequency(frequency_hz)
    with atomic_folder(folder) as target:
        write_map(partial, target, settings, offset_m=offset_m, frequency_hz=frequency_hz)
        write_ros_map(partial, target / "map.yaml", {"scene_offset": offset_m})
    return Path(folder)
