import zipfile
path = valid("predictor.keras", folder)
with zipfile.ZipFile(path) as archive:
    members = {name: archive.read(name) for name in archive.namelist()}
members["config.json"] = members["config.json"].replace(b'"units": 20', b'"units": 1000000000')
with zipfile.ZipFile(path, "w") as archive:
    for name, data in members.items():
        archive.writestr(name, data)
must_refuse(lambda: sp.Predictor.load(path))
