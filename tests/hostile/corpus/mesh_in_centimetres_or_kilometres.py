path = valid("mesh.obj", folder)
text = path.read_text()
for factor in (100.0, 0.001):
    rows = [line.split() for line in text.splitlines()]
    scaled = [" ".join(["v", *(str(float(x) * factor) for x in row[1:])]) if row[0] == "v" else " ".join(row) for row in rows]
    path.write_text("\n".join(scaled))
    must_refuse(lambda: sp.load_map(path, resolution_m=0.2))
