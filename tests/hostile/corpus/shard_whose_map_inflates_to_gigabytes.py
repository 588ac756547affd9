import base64, json, zlib
import pyarrow.parquet as pq
path = valid("dataset.parquet", folder)
table = pq.read_table(path)
notes = dict(table.schema.metadata)
maps = json.loads(notes[b"sionna_partial.maps"])
deflate = zlib.compressobj(1)
bomb = b"".join(deflate.compress(bytes(1 << 24)) for _ in range(60)) + deflate.flush()
for shape in ([2, 2], [60_000, 60_000], [-1, -1], [10**30, 1], [1.5, "x"]):
    maps["partial"][0] |= {"shape": shape, "cells": base64.b64encode(bomb).decode()}
    notes[b"sionna_partial.maps"] = json.dumps(maps).encode()
    pq.write_table(table.replace_schema_metadata(notes), path)
    must_refuse(lambda: sp.lab.read_dataset(path.parent.parent))
