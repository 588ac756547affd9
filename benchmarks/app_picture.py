"""Picture of the app's page with two access points in the example home, and times from drops, in headless Chromium.

python benchmarks/app_picture.py [--out docs/app.png]
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from browser import chromium

MODEL = "Bokeh.documents[0].get_model_by_name"
WIDTH, HEIGHT, WAIT_S = 1400, 950, 600.0
PLACES_M = (6.0, 9.0), (5.5, 10.5), (7.5, 9.5), (4.0, 6.5), (6.5, 8.5)
DROP = f"""(async () => {{
const title = {MODEL}('picture').title, start = performance.now(), until = async test => {{
    while (!test()) await new Promise(done => setTimeout(done, 5))
    return (performance.now() - start) / 1e3
}}
{MODEL}('points').data = {{x: [X], y: [Y], name: ['tx1'], colour: ['']}}
return [await until(() => title.text.includes('coarse')), await until(() => !title.text.includes('coarse'))]
}})()"""


def dropped_s(tab: Any, shift_m: float) -> np.ndarray:
    """Return times from drops of a transmitter, at new positions, to the coarse and the fine picture (5, 2) [s]."""
    times_s = []
    for x_m, y_m in PLACES_M:
        times_s.append(tab.run(DROP.replace("X", str(x_m + shift_m)).replace("Y", str(y_m))))
        tab.wait(f"{MODEL}('message').text.includes('Ready')", WAIT_S)
    return np.array(times_s)


def main() -> None:
    """Open the page, drop the transmitter, add an access point, and take the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/app.png"))
    out = parser.parse_args().out
    command = [sys.executable, "-m", "sionna_partial", "app", "--no-browser"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server,
        tempfile.TemporaryDirectory() as folder,
    ):
        assert server.stdout is not None
        with chromium(Path(folder)) as open_tab:
            tab = open_tab(server.stdout.readline().split()[1], WIDTH, HEIGHT)
            tab.wait(f"{MODEL}('message').text.includes('Ready')", WAIT_S)
            dropped_s(tab, 0.0)  # the first are slower
            coarse_s, fine_s = np.median(dropped_s(tab, 0.2), axis=0)
            print(f"from a drop to the coarse picture {coarse_s:.2f} s, to the fine one {fine_s:.2f} s (median of 5)")
            tab.run(f"{MODEL}('preset').value = 'Wi-Fi 5 GHz', {MODEL}('layer').value = 'power_mean_dbm', 0")
            tab.run(
                f"(() => {{ const points = {MODEL}('points'); points.data = {{x: [7, 7.5], y: [9.8, 3.5], "
                "name: ['tx1', ''], colour: ['', '']}; return 0 })()"
            )
            tab.wait(f"{MODEL}('python').value.includes('tx2') && {MODEL}('python').value.includes('5210')", WAIT_S)
            tab.wait(f"{MODEL}('message').text.includes('Ready')", WAIT_S)
            tab.run("new Promise(done => setTimeout(done, 1000))")
            tab.screenshot(out)
        server.terminate()


if __name__ == "__main__":
    main()
