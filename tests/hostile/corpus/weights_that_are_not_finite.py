import keras, json, hashlib
path = valid("predictor.keras", folder)
model = keras.saving.load_model(path)
model.set_weights([weight * np.nan for weight in model.get_weights()])
model.save(path)
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
