"""Picture and animation of the app's page, two access points in the example home at 5 GHz, and times from drops.

Times are at 5 GHz through walls of unknown material, and at 28 GHz.

python benchmarks/app_picture.py [--out docs/app.png] [--gif docs/app.gif]

For the animation a transmitter at 28 GHz is dragged through the home.
"""

import argparse
import io
import itertools
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from browser import chromium
from test_app import pixel

MODEL = "Bokeh.documents[0].get_model_by_name"
READY = f"{MODEL}('message').text.includes('Ready')"
BANDS = ("Wi-Fi 5 GHz", "5G, 28 GHz")
WIDTH, HEIGHT, WAIT_S = 1400, 950, 600.0
PLACES_M = ((7.0, 9.8), (8.6, 8.6), (7.5, 3.5), (7.0, 9.8))
"""Positions [m] from which the transmitter is dragged to the next one."""
DROPS_M = ((6.0, 9.0), (5.5, 10.5), (7.5, 9.5), (4.0, 6.5), (6.5, 8.5))
DROP = f"""(async () => {{
const title = {MODEL}('picture').title, start = performance.now(), until = async test => {{
    while (!test()) await new Promise(done => setTimeout(done, 5))
    return (performance.now() - start) / 1e3
}}
{MODEL}('points').data = {{x: [X], y: [Y], name: ['tx1'], colour: ['']}}
return [await until(() => title.text.includes('coarse')), await until(() => !title.text.includes('coarse'))]
}})()"""
MOVES, MOVE_MS, COARSE_MS, FINE_MS = 8, 80, 400, 1600
GIF_WIDTH, COLOURS = 760, 64


def dropped_s(tab: Any, shift_m: float) -> np.ndarray:
    """Return times from drops of a transmitter, at new positions, to the coarse and the fine picture (5, 2) [s]."""
    times_s = []
    for x_m, y_m in DROPS_M:
        times_s.append(tab.run(DROP.replace("X", str(x_m + shift_m)).replace("Y", str(y_m))))
        tab.wait(READY, WAIT_S)
    return np.array(times_s)


def shot(tab: Any, folder: Path) -> Image.Image:
    """Return the page as a picture of the animation."""
    tab.screenshot(folder / "frame.png")
    with Image.open(io.BytesIO((folder / "frame.png").read_bytes())) as picture:
        size = GIF_WIDTH, round(GIF_WIDTH * picture.height / picture.width)
        return picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)


def record(tab: Any, folder: Path, path: Path) -> None:
    """Drag the transmitter of the page, and write the pictures as an animation."""
    tab.run(f"{MODEL}('layer').value = 'gain_mean_db', 0")
    tab.wait(f"{MODEL}('picture').title.text.includes('gain')", WAIT_S)
    tab.run(f"{MODEL}('picture').toolbar.tools.filter(t => t.type == 'HoverTool').forEach(t => t.active = false), 0")
    frames: list[tuple[Image.Image, int]] = []
    for start_m, stop_m in itertools.pairwise(PLACES_M):
        tab.mouse("mouseMoved", *pixel(tab, *start_m))
        tab.mouse("mousePressed", *pixel(tab, *start_m))
        for place_m in np.linspace(start_m, stop_m, MOVES + 1)[1:].tolist():
            x, y = pixel(tab, *place_m)
            tab.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left", buttons=1)
            frames.append((shot(tab, folder), MOVE_MS))
        tab.mouse("mouseReleased", *pixel(tab, *stop_m))
        for shown, duration_ms in (("(coarse)", COARSE_MS), ("", FINE_MS)):
            tab.wait(f"{MODEL}('picture').title.text.includes('{shown}') && ('{shown}' || {READY})", WAIT_S)
            tab.run("new Promise(done => setTimeout(done, 200))")
            frames.append((shot(tab, folder), duration_ms))
    pictures = [picture for picture, _ in frames]
    palette = pictures[-1].quantize(COLOURS)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first.save(path, save_all=True, append_images=others, duration=[ms for _, ms in frames], loop=0, optimize=True)


def main() -> None:
    """Open the page, add an access point, and take the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/app.png"))
    parser.add_argument("--gif", type=Path)
    given = parser.parse_args()
    command = [sys.executable, "-m", "sionna_partial", "app", "--no-browser"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server,
        ExitStack() as stack,
        tempfile.TemporaryDirectory() as folder,
    ):
        stack.callback(server.terminate)  # also after a failure: the server would be waited for
        assert server.stdout is not None
        with chromium(Path(folder)) as open_tab:
            tab = open_tab(server.stdout.readline().split()[1], WIDTH, HEIGHT)
            tab.wait(READY, WAIT_S)
            for name in BANDS:
                tab.run(f"{MODEL}('preset').value = '{name}', 0")
                dropped_s(tab, 0.0)  # the first are slower
                coarse_s, fine_s = np.median(dropped_s(tab, 0.2), axis=0)
                print(f"{name}: from a drop to the coarse picture {coarse_s:.2f} s, to the fine one {fine_s:.2f} s")
            if given.gif:
                record(tab, Path(folder), given.gif)
            tab.run(f"{MODEL}('preset').value = '{BANDS[0]}', {MODEL}('layer').value = 'power_mean_dbm', 0")
            tab.wait(f"{MODEL}('python').value.includes('5210')", WAIT_S)
            tab.run(
                f"(() => {{ const points = {MODEL}('points'); points.data = {{x: [7, 7.5], y: [9.8, 3.5], "
                "name: ['tx1', ''], colour: ['', '']}; return 0 })()"
            )
            tab.wait(f"{MODEL}('python').value.includes('tx2')", WAIT_S)
            tab.wait(READY, WAIT_S)
            tab.run("new Promise(done => setTimeout(done, 1000))")
            tab.screenshot(given.out)


if __name__ == "__main__":
    main()
