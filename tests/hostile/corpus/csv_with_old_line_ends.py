from sionna_partial.measurements.measurements import measurements_of

path = valid("measurements.csv", folder)
expected = measurements_of(path).gain_db
path.write_bytes(path.read_bytes().replace(b"\n", b"\r"))
if not np.array_equal(measurements_of(path).gain_db, expected):
    raise Wrong("other gains")
