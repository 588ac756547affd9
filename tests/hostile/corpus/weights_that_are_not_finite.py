import json, hashlib, io
import h5py
from sionna_partial.files import unzipped, zipped
path = valid("predictor.keras", folder)
contents = unzipped(path.read_bytes(), 10**8)
weights = io.BytesIO(contents["model.weights.h5"])
with h5py.File(weights, "r+") as file:
    def spoil(name, each):
        if isinstance(each, h5py.Dataset) and each.dtype.kind == "f":
            each[...] = np.full(each.shape, np.nan)
    file.visititems(spoil)
path.write_bytes(zipped(contents | {"model.weights.h5": weights.getvalue()}))
card = json.loads(path.with_suffix(".json").read_text())
text = path.with_suffix(".json").read_text()
for value in card.values():
    if isinstance(value, str) and len(value) == 64:
        text = text.replace(value, hashlib.sha256(path.read_bytes()).hexdigest())
path.with_suffix(".json").write_text(text)
try:
    sp.Predictor.load(path)
except sp.SionnaPartialError as error:
    assert "not finite" in str(error), error
else:
    raise Wrong("loaded")
