"""Time of a warm LinkModel, relative to the first `predict_map` of a fresh process: the shipped apartment at 0.15 m.

python benchmarks/warm.py
"""

import argparse
import subprocess
import sys
import time

import numpy as np

import sionna_partial as sp

TX, OTHER_TX = (7.0, 9.8, 1.5), (6.6, 9.2, 1.5)

FIRST = """
import time, sionna_partial as sp
partial = sp.load_map({path!r})
begin = time.perf_counter()
sp.predict_map(partial, {tx}, progress=False)
print(time.perf_counter() - begin)
"""


def seconds(call, *arguments):
    """Time one call."""
    begin = time.perf_counter()
    call(*arguments)
    return time.perf_counter() - begin


def main():
    """Print the table of docs/predict.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5, help="repetitions, of which the median is printed")
    runs = parser.parse_args().runs
    path = "scenes/apartment/step100"
    script = FIRST.format(path=path, tx=TX)
    first = float(
        np.median([float(subprocess.check_output([sys.executable, "-c", script])) for _ in range(min(runs, 3))])
    )
    partial = sp.load_map(path)
    grown = sp.explore(sp.load_map("scenes/apartment/complete"), steps=(100, 120), seed=0)
    model = sp.LinkModel(partial)
    sp.predict_map(model, TX, progress=False)
    offsets_m = np.linspace(0.0, 0.5, runs)
    times = {
        "the first predict_map of a process": [first],
        "the same transmitter": [seconds(sp.predict_map, model, TX) for _ in range(runs)],
        "another transmitter": [
            seconds(sp.predict_map, model, np.add(OTHER_TX, (each, 0.0, 0.0))) for each in offsets_m
        ],
        "predict_map of the map, no model kept": [seconds(sp.predict_map, partial, TX) for _ in range(runs)],
    }
    updated = []
    for _ in range(runs):
        model.update(grown[0])
        sp.predict_map(model, TX)
        updated.append(seconds(lambda: (model.update(grown[1]), sp.predict_map(model, TX))))
    times["update with 20 more steps of exploration"] = updated
    print(f"first predict_map: {first:.2f} s")
    for name, each in times.items():
        print(f"| {name} | {np.median(each) / first:.3f} |")


if __name__ == "__main__":
    main()
