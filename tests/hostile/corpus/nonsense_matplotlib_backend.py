result = python("import sys; sys.argv = ['sionna-partial', '--help']; from sionna_partial.cli import main; main()", MPLBACKEND="nonsense")
must_end_in_one_line(result, 0)
command_line = ["predict", str(valid("map.yaml", folder)), "--tx", "1.1", "1.1", "--spacing", "1.0", "--predictor", "paper", "--out", str(folder / "out")]
result = python(f"import sys; sys.argv = ['sionna-partial', *{command_line!r}]; from sionna_partial.cli import main; main()", MPLBACKEND="nonsense")
must_end_in_one_line(result, 0, 2)
