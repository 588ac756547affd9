state = np.zeros((200, 200), np.uint8)
state[[0, -1]] = state[:, [0, -1]] = sp.CellState.WALL
settings = sp.TraceSettings(max_depth=0, diffraction=False)
coverage = sp.predict_map(sp.PartialMap(state, 0.1), (5.0, 5.0), spacing_m=0.02, trace_settings=settings)
if coverage.valid.size != 1_000_000 or np.isnan(coverage.gain_mean_db.where(coverage.valid == 1).max()):
    raise Wrong(f"{coverage.valid.size} receivers")
must_refuse(lambda: sp.predict_map(sp.PartialMap(state, 0.1), (5.0, 5.0), spacing_m=0.01))
