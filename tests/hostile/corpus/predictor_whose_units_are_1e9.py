import hashlib, json, zipfile
path = valid("predictor.keras", folder)
with zipfile.ZipFile(path) as archive:
    members = {name: archive.read(name) for name in archive.namelist()}
for old, new in ((b'"units": 20', b'"units": 1000000000'), (b'"units": 20', b'"lora_rank": 1000000000, "units": 20')):
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data.replace(old, new) if name == "config.json" else data)
    card = json.loads(path.with_suffix(".json").read_text())
    card["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_text(json.dumps(card))
    try:
        sp.Predictor.load(path)
    except sp.SionnaPartialError as error:
        assert "1,000,000,000" in str(error), error
    else:
        raise Wrong("loaded")
