"""Tries a libLLVM on a real path solve; runs in a process of its own: `python -m sionna_partial.llvm_probe PATH`."""

import json
import resource
import sys
from pathlib import Path

from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.llvm import OLDEST_MAJOR, library_version, open_library

SCENE = """
<scene version="2.1.0">
  <bsdf type="itu-radio-material" id="floor-material">
    <string name="type" value="concrete"/>
    <float name="thickness" value="0.1"/>
  </bsdf>
  <shape type="rectangle" id="floor">
    <transform name="to_world"><scale value="5"/></transform>
    <ref id="floor-material" name="bsdf"/>
  </shape>
</scene>
"""
"""A floor of 10 x 10 m at z = 0, concrete."""

LENGTHS_M = (2.0, 8.0**0.5)
"""Lengths of the direct path and of the one by the floor, between points 2 m apart and 1 m high [m]."""


def probe(path: Path) -> tuple[str, str]:
    """Version of the library at `path`, and what is wrong with it ("" if it works).

    A library that Dr.Jit cannot work with may abort the process.
    """
    try:
        version = library_version(open_library(path), path)
        if not version:
            return "", "it is no libLLVM, or one of unknown version"
        if int(version.partition(".")[0]) < OLDEST_MAJOR:
            return version, f"LLVM {version} is older than {OLDEST_MAJOR} and cannot compile path kernels"
        lengths_m = solved_lengths_m()
    except (ImportError, OSError, RuntimeError) as error:
        return "", " ".join(str(error).split())[:200]
    fits = len(lengths_m) == len(LENGTHS_M) and all(
        abs(solved - true) < 1e-3 for solved, true in zip(lengths_m, LENGTHS_M, strict=True)
    )
    return version, "" if fits else f"path lengths are {lengths_m} m instead of {LENGTHS_M} m"


def solved_lengths_m() -> list[float]:
    """Lengths of the paths over the floor, ascending, as Sionna RT solves them [m]."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono_polarized")
    from sionna import rt

    scene = rt.load_scene_from_string(SCENE)
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Transmitter("tx", position=[-1.0, 0.0, 1.0]))
    scene.add(rt.Receiver("rx", position=[1.0, 0.0, 1.0]))
    paths = rt.PathSolver()(scene, max_depth=2, samples_per_src=1000)
    delays_s = paths.tau.numpy()[paths.valid.numpy()]
    return sorted(float(delay) * SPEED_OF_LIGHT_M_S for delay in delays_s if delay > 0)


def main() -> None:
    """Print the verdict on the library named on the command line as JSON."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    version, fault = probe(Path(sys.argv[1]))
    sys.stdout.write("\n" + json.dumps({"version": version, "fault": fault}))


if __name__ == "__main__":
    main()
