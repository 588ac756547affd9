import subprocess, sys
code = "import sys; sys.argv = ['sionna-partial', 'info']; from sionna_partial.cli import main; main()"
with open("/dev/full", "w") as full:
    result = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True)
must_end_in_one_line(result, 1, 2)
