import os, signal, subprocess, sys, time
code = "import sys; sys.argv = ['sionna-partial', 'predict', %r, '--tx', '1.1', '1.1', '--out', %r]; from sionna_partial.cli import main; main()"
for seconds in (0.3, 1.0, 2.0, 3.5, 6.0):
    process = subprocess.Popen([sys.executable, "-c", code % (str(valid("map.yaml", folder)), str(folder / "out"))], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    time.sleep(seconds)
    if process.poll() is not None:
        break
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    _, errors = process.communicate(timeout=60)
    if process.returncode not in (130, 0) or "Traceback" in errors or "sionna-rt" in errors:
        raise Wrong(f"after {seconds} s: exit {process.returncode}: {errors[-800:]}")
