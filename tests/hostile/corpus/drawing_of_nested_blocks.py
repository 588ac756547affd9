import ezdxf
plan = ezdxf.new(units=6)
for level in range(14):
    block = plan.blocks.new(f"B{level}")
    for _ in range(20 if level else 0):
        block.add_blockref(f"B{level - 1}", (0, 0))
plan.modelspace().add_blockref("B13", (0, 0), dxfattribs={"layer": "WALLS"}).grid((30000, 30000), (1, 1))
plan.saveas(folder / "plan.dxf")
must_refuse(lambda: sp.load_map(folder / "plan.dxf"))
