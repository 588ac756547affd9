must_refuse(lambda: sp.map_from_array(np.zeros((4, 5)), True))
must_refuse(lambda: sp.PartialMap(np.zeros((4, 5), np.uint8), True))
must_refuse(lambda: sp.map_from_occupancy(np.zeros((4, 5), np.int8), 0.1, occupied_percent=0.65))
must_refuse(lambda: sp.TraceSettings(max_depth=True))
