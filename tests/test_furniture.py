import numpy as np
import shapely
from shapely import LineString, Polygon, box

from sionna_partial.worlds.buildings import furnish, union_of

ROOM = box(0, 0, 5, 4)
DOOR = LineString([(1, 0), (1.9, 0)])
WALK_M = 0.6
SEEDS = range(12)


def walls_of(room: Polygon) -> Polygon:
    return room.boundary.buffer(0.05).difference(DOOR.buffer(0.1, cap_style="flat"))


def furnished(seed: int, room: Polygon = ROOM, clutter: float = 3.0, pillars: float = 0.0) -> list[Polygon]:
    rng = np.random.default_rng(seed)
    return list(furnish(rng, room, walls_of(room), [DOOR], walk_m=WALK_M, clutter=clutter, pillars=pillars))


def test_all_that_is_left_can_be_walked_to_from_the_door() -> None:
    doorstep = box(1, 0, 1.9, WALK_M).buffer(-1e-3)
    for seed in SEEDS:
        things = furnished(seed)
        assert things
        assert not any(thing.intersects(doorstep) for thing in things)
        left = ROOM.difference(union_of([walls_of(ROOM), *things])).union(box(1, -0.9, 1.9, 0.1))
        walkable = left.buffer(-WALK_M / 2)
        assert walkable.geom_type == "Polygon"
        assert walkable.intersects(DOOR)


def test_shapes_are_of_many_kinds() -> None:
    things = [thing for seed in SEEDS for thing in furnished(seed)]
    corners = {len(shapely.get_coordinates(thing)) - 1 for thing in things}
    assert 4 in corners
    assert max(corners) > 12
    rectangular = [thing.area > 0.99 * thing.minimum_rotated_rectangle.area for thing in things]
    assert 0.2 < np.mean(rectangular) < 0.9


def test_pillars_stand_in_large_rooms_only() -> None:
    for seed in SEEDS:
        assert furnished(seed, clutter=0.0, pillars=1.0, room=box(0, 0, 4, 4)) == []
    hall = box(0, 0, 12, 10)
    pillars = [thing for seed in SEEDS for thing in furnished(seed, hall, clutter=0.0, pillars=1.0)]
    assert len(pillars) > len(SEEDS)
    assert max(pillar.area for pillar in pillars) < 0.37
