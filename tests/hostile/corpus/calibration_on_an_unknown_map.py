nothing = sp.PartialMap(np.full((15, 20), 2, np.uint8), 0.2)
must_refuse(lambda: sp.calibrate_materials(nothing, valid("measurements.csv", folder)))
