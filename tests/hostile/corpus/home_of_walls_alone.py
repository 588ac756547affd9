sp.save_map(sp.PartialMap(np.ones((9, 9), int), 0.1), folder / "block.npz")
try:
    sp.build_dataset(folder / "links", [folder / "block.npz"], workers=1)
except sp.SionnaPartialError as error:
    if "touches an unknown" in str(error):
        raise Wrong(str(error))
    raise
