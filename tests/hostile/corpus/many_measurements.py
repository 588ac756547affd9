path = folder / "many.csv"
rng = np.random.default_rng(0)
rows = [f"1.1,1.1,1.5,{0.5 + 1.4 * x:.2f},2.3,1.5,{-60.0 - 5.0 * x:.3f}" for x in rng.random(100_000)]
path.write_text("\n".join(["tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,gain_db", *rows]) + "\n")
try:
    sp.calibrate_materials(room(), path)
except sp.SionnaPartialError:
    pass
