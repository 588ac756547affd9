def sheet(corner, along, across, parts):
    u, v = np.meshgrid(*2 * [np.linspace(0.0, 1.0, parts + 1)], indexing="ij")
    a = ((parts + 1) * np.arange(parts)[:, None] + np.arange(parts)).ravel()
    b, c, d = a + 1, a + parts + 2, a + parts + 1
    return corner + u.reshape(-1, 1) * along + v.reshape(-1, 1) * across, np.stack([a, b, c, a, c, d], 1).reshape(-1, 3)

def box(parts):
    o, x, y, z = np.zeros(3), np.array([4.0, 0, 0]), np.array([0, 3.0, 0]), np.array([0, 0, 2.5])
    sides = [sheet(*side, parts) for side in ((o, x, y), (o, x, z), (o, y, z), (x, y, z), (y, x, z))]
    vertices = np.concatenate([points for points, _ in sides]).astype("<f4")
    faces = np.zeros(5 * 2 * parts**2, dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, np.concatenate([part + i * (parts + 1) ** 2 for i, (_, part) in enumerate(sides)])
    rows = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *(f"property float {c}" for c in "xyz")]
    rows += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    (folder / "box.ply").write_bytes("\n".join(rows).encode() + vertices.tobytes() + faces.tobytes())
    return folder / "box.ply"

partial = sp.load_map(box(707), resolution_m=0.1)
if len(partial.mesh.triangles) != 4_998_490:
    raise Wrong(f"{len(partial.mesh.triangles)} triangles")
path = box(708)
must_refuse(lambda: sp.load_map(path, resolution_m=0.1))
