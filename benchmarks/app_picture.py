"""Picture of the app's page: two access points in the example home at 5 GHz, in headless Chromium.

python benchmarks/app_picture.py [--out docs/app.png]
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from browser import chromium

MODEL = "Bokeh.documents[0].get_model_by_name"
WIDTH, HEIGHT, WAIT_S = 1400, 950, 600.0


def main() -> None:
    """Open the page, add an access point, and take the picture."""
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
