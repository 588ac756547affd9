"""Measure how fast a data set is built: homes a minute, and processor time for each home.

Run it with

    python benchmarks/dataset.py --homes 20 --workers 2
"""

import argparse
import resource
import tempfile

from sionna_partial.datasets.dataset import build_dataset
from sionna_partial.settings import DatasetSettings


def main() -> None:
    """Build a data set in a temporary folder, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.homes)
    settings = DatasetSettings()
    with tempfile.TemporaryDirectory() as folder:
        report = build_dataset(folder, seeds, settings, workers=arguments.workers)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    links = 2 * settings.links_per_home * len(settings.stages)
    print(f"{len(report.built)} homes of {links} links with {arguments.workers} workers in {report.elapsed_s:.0f} s")
    print(f"{60 * len(report.built) / report.elapsed_s:.1f} homes a minute, start included")
    print(f"{(used.ru_utime + used.ru_stime) / len(report.built):.2f} s of processor time a home")
    print(f"largest process {used.ru_maxrss / 1e6:.2f} GB")


if __name__ == "__main__":
    main()
