words = ("calibrate", valid("map.yaml", folder), "--measurements", valid("measurements.csv", folder), "--out", folder / "out")
for seconds in (3.0, 4.0, 5.0, 6.0):
    must_end_at_signal(words, signal.SIGINT, seconds)
