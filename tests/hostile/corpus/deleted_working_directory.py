result = python("import os, tempfile; d = tempfile.mkdtemp(); os.chdir(d); os.rmdir(d); import sys; sys.argv = ['sionna-partial', 'info']; from sionna_partial.cli import main; main()")
must_end_in_one_line(result, 1, 2)
