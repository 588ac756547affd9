import base64, json, zlib
import pyarrow.parquet as pq
path = valid("dataset.parquet", folder)
table = pq.read_table(path)
notes = dict(table.schema.metadata)
maps = json.loads(notes[b"sionna_partial.maps"])
deflate, part, checksum = zlib.compressobj(1), bytes(1 << 24), 1
first, again = (deflate.compress(part) + deflate.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
for _ in range(60):
    checksum = zlib.adler32(part, checksum)
bomb = first + 59 * again + deflate.flush()[:-4] + checksum.to_bytes(4)
for shape in ([2, 2], [60_000, 60_000], [-1, -1], [10**30, 1], [1.5, "x"]):
    maps["partial"][0] |= {"shape": shape, "cells": base64.b64encode(bomb).decode()}
    notes[b"sionna_partial.maps"] = json.dumps(maps).encode()
    pq.write_table(table.replace_schema_metadata(notes), path)
    must_refuse(lambda: sp.lab.read_dataset(path.parent.parent))
