words = ("predict", valid("map.yaml", folder), "--tx", "1.1", "1.1", "--out", folder / "out")
for seconds in (0.3, 1.0, 2.0, 3.5, 6.0):
    must_end_at_signal(words, signal.SIGINT, seconds)
