path = valid("measurements.csv", folder)
path.write_text(path.read_text().replace(",", ";").replace(".", ","))
try:
    sp.calibrate_materials(room(), path)
except sp.SionnaPartialError as error:
    if "negative" in str(error) or "separat" not in str(error):
        raise Wrong(str(error)) from error
