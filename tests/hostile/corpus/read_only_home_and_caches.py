result = python("import sys; sys.argv = ['sionna-partial', 'info']; from sionna_partial.cli import main; main()",
    HOME="/proc/nowhere", NUMBA_CACHE_DIR="/proc/nowhere", XDG_CACHE_HOME="/proc/nowhere")
must_end_in_one_line(result, 0)
