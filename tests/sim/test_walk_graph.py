"""The walk graph against the town it was made of, looked at in other ways than it was built."""

import dataclasses
import pathlib

import numpy as np
import pytest
from small_world import lane, network, road, straight
from walking_world import inside, street, to_pavement

from carljax.sim import atlas, road_map_builder, town, walk_graph
from carljax.sim.road_map import (
    LAYER_JUNCTION,
    LAYER_ROAD,
    PIXELS_PER_METRE,
    WALK_CROSSING,
    WALK_JAYWALK,
    WALK_PAVEMENT,
    WALK_TO_CROSSING,
    WALK_TO_JAYWALK,
)

DATA = pathlib.Path(__file__).parents[2].parent / "shared" / "data" / "maps"
WITH_PAVEMENT = ("grid", "village", "highway", "Town01", "Town02", "Town07")


@pytest.fixture(scope="module", params=WITH_PAVEMENT)
def there(request, bundled):
    """A town and its atlas."""
    name = request.param
    if name in bundled:
        one = bundled[name]
    elif (DATA / f"{name}.xodr").exists():
        one = town.load(DATA / f"{name}.xodr")
    else:
        pytest.skip(f"{DATA / name}.xodr is not there")
    origin, shape = atlas.frame(one.network)
    return one, atlas.layers(one.network, origin, shape), origin


def edges(graph, *kinds):
    """(from, to) of all edges of the given kinds."""
    rows, columns = np.nonzero((graph.neighbours >= 0) & np.isin(graph.kind, kinds))
    return np.stack([rows, graph.neighbours[rows, columns]], axis=-1)


def bits(layers, origin, xy):
    """Atlas bits under places (..., 2)."""
    at = np.round((xy - origin) * PIXELS_PER_METRE).astype(int)
    return layers[at[..., 1], at[..., 0]]


def along(graph, pairs, num=41):
    """(E, num, 2) places on edges, the ends included."""
    start, end = graph.xyz[pairs[:, 0], None, :2], graph.xyz[pairs[:, 1], None, :2]
    return start + np.linspace(0, 1, num)[:, None] * (end - start)


def test_nodes_lie_on_pavements(there):
    one, _, _ = there
    graph = one.walks
    at_crosswalk = np.zeros(len(graph.xyz), bool)
    at_crosswalk[edges(graph, WALK_CROSSING)] = True
    off = to_pavement(one.network, graph.xyz[:, :2])
    assert len(off) > 100 and off[~at_crosswalk].max() < 0.02
    # Where a pavement ends before the crosswalk, people wait beside it.
    assert off[at_crosswalk].max(initial=0.0) < 3.0


def test_ways_along_pavements_stay_off_the_carriageway(there):
    one, layers, origin = there
    on = along(one.walks, edges(one.walks, WALK_PAVEMENT, WALK_TO_CROSSING, WALK_TO_JAYWALK))
    assert not (bits(layers, origin, on) & LAYER_ROAD).any()


def test_ways_along_pavements_leave_them_only_at_gaps(there):
    one, _, _ = there
    on = along(one.walks, edges(one.walks, WALK_PAVEMENT), 5)
    off = to_pavement(one.network, on.reshape(-1, 2)).reshape(on.shape[:2]).max(axis=1) > 0.02
    assert off.mean() < 0.02  # where pavements end within 3 m of one another


def test_crossings_lead_over_crosswalks(there):
    one, layers, origin = there
    pairs = edges(one.walks, WALK_CROSSING)
    for line in along(one.walks, pairs):
        on_road = (bits(layers, origin, line) & LAYER_ROAD) > 0
        best = max(inside(p[:, :2], line)[on_road].mean() for p in one.network.crosswalks)
        assert on_road.mean() > 0.3 and best > 0.95


@pytest.mark.parametrize(("name", "used"), [("grid", 40), ("village", 4), ("highway", 4)])
def test_every_crosswalk_between_two_pavements_is_used(bundled, name, used):
    # In the village three lead to the open country, on the highway two.
    assert len(edges(bundled[name].walks, WALK_CROSSING)) == 2 * used


def test_other_ways_across_are_straight_short_and_away_from_junctions(there):
    one, layers, origin = there
    table, pairs = one.lanes, edges(one.walks, WALK_JAYWALK)
    for line in along(one.walks, pairs):
        under = bits(layers, origin, line)
        step = np.hypot(*(line[1] - line[0]))
        assert not (under & LAYER_JUNCTION).any()
        assert 2.5 < step * ((under & LAYER_ROAD) > 0).sum() < 16.0
        middle = np.argmin(np.hypot(*(table.point_xyz[:, :2] - line[20]).T))
        way = np.arctan2(*(line[-1] - line[0])[::-1])
        assert abs(np.cos(way - table.point_yaw[middle])) < 0.35
        for polygon in one.network.crosswalks:
            assert np.hypot(*(polygon[:, :2].mean(axis=0) - line[20])) > 14.0


def test_every_way_leads_back(there):
    graph = there[0].walks
    pairs = edges(graph, *range(5))
    assert {tuple(x) for x in pairs} == {tuple(x[::-1]) for x in pairs}
    assert (pairs[:, 0] != pairs[:, 1]).all() and len(np.unique(pairs, axis=0)) == len(pairs)
    for kind in (WALK_CROSSING, WALK_JAYWALK):
        across = edges(graph, kind)
        assert {tuple(x) for x in across} == {tuple(x[::-1]) for x in across}
        assert graph.is_kerb[across].all()


def test_a_kerb_has_its_way_across_and_its_way_back(there):
    graph = there[0].walks
    kinds = [sorted(k[n >= 0]) for n, k in zip(graph.neighbours, graph.kind, strict=True)]
    for row in np.flatnonzero(graph.is_kerb):
        assert kinds[row] in ([WALK_PAVEMENT, WALK_CROSSING], [WALK_PAVEMENT, WALK_JAYWALK])
    for row in np.flatnonzero(~graph.is_kerb):
        assert WALK_CROSSING not in kinds[row] and WALK_JAYWALK not in kinds[row]
        assert WALK_PAVEMENT in kinds[row]


def test_directions_are_those_of_the_edges(there):
    graph = there[0].walks
    rows, columns = np.nonzero(graph.neighbours >= 0)
    d = graph.xyz[graph.neighbours[rows, columns], :2] - graph.xyz[rows, :2]
    want = d / np.hypot(*d.T)[:, None]
    yaw = graph.yaw[rows, columns]
    np.testing.assert_allclose(np.stack([np.cos(yaw), np.sin(yaw)], axis=-1), want, atol=1e-9)


def test_the_street_has_the_ways_one_expects():
    graph = town.from_network(street()).walks
    crossing = graph.xyz[edges(graph, WALK_CROSSING)[0], :2]
    # The crosswalk's middle is x = 0; people wait 0.4 m beyond its ends at 3.5 m.
    np.testing.assert_allclose(sorted(crossing.tolist()), [[0, -3.9], [0, 3.9]], atol=1e-9)
    # 11 places 18.2 m apart on 200 m: -90.9, -72.7, ..., 90.9; the one at 0 is too near.
    across = graph.xyz[edges(graph, WALK_JAYWALK)[:, 0], 0]
    want = (np.arange(11) - 5) * 200 / 11
    np.testing.assert_allclose(np.unique(across.round(3)), want[want != 0], atol=0.3)
    pavement = graph.xyz[~graph.is_kerb]
    np.testing.assert_allclose(abs(pavement[:, 1]), 4.5, atol=1e-9)
    assert np.diff(np.sort(pavement[pavement[:, 1] > 0, 0])).max() < 4.6


def test_height_is_that_of_the_lane_beside():
    net = street()
    raised = tuple(
        dataclasses.replace(x, xyz=x.xyz + [0, 0, 5.0 if x.kind == "driving" else 5.15])
        for x in net.lanes
    )
    graph = town.from_network(dataclasses.replace(net, lanes=raised)).walks
    np.testing.assert_allclose(graph.xyz[:, 2], 5.0)


def test_a_footbridge_is_not_joined_to_the_pavement_below():
    bridge = lane([(0, -29), (0, 29)], z=8.0, kind="sidewalk", width=np.full(2, 2.0))
    net = street()
    graph = town.from_network(dataclasses.replace(net, lanes=(*net.lanes, bridge))).walks
    on_bridge = abs(graph.xyz[:, 0]) < 0.01
    on_bridge &= ~graph.is_kerb & (abs(abs(graph.xyz[:, 1]) - 4.5) > 0.01)
    pairs = edges(graph, *range(5))
    assert on_bridge.sum() >= 20
    assert (on_bridge[pairs[:, 0]] == on_bridge[pairs[:, 1]]).all()


def test_pavements_that_end_near_one_another_are_joined():
    ends = [((-50, -4.5), (-1, -4.5)), ((1, -4.5), (50, -4.5)), ((55, -4.5), (90, -4.5))]
    pavements = [straight(a, b, kind="sidewalk") for a, b in ends]
    graph = town.from_network(network([straight((-100, 0), (100, 0)), *pavements])).walks
    gaps = along(graph, edges(graph, WALK_PAVEMENT), 3)[:, 1, 0] + town_shift(graph)
    assert (abs(gaps) < 0.01).sum() == 2  # the gap of 2 m, both ways
    assert not ((gaps > 50) & (gaps < 55)).any()  # not the one of 5 m


def town_shift(graph):
    """The hand-made towns here have their middle at 0, so they stay where they are."""
    assert abs(graph.xyz[:, 0].min() + 50) < 0.01
    return 0.0


@pytest.mark.parametrize("name", ["road", "Town06"])
def test_a_town_without_pavements_has_nobody(name):
    path = DATA / "Town06.xodr"
    if name == "Town06" and not path.exists():
        pytest.skip(f"{path} is not there")
    one = town.load(path) if name == "Town06" else town.from_network(road(0, 50, 100))
    assert len(one.walks.xyz) == 0
    assert (walk_graph.respawn_table(one.walks, np.zeros(2), (100, 60), 0) == -1).all()
    if name == "road":
        rows = road_map_builder.build([one])
        assert rows.walk_xyz.shape == (1, 3) and (np.asarray(rows.walk_neighbours) == -1).all()


def test_places_to_appear_lie_in_a_ring_and_on_pavements(bundled):
    one = bundled["grid"]
    origin, shape = atlas.frame(one.network)
    extent = (shape[1] / PIXELS_PER_METRE, shape[0] / PIXELS_PER_METRE)
    table = walk_graph.respawn_table(one.walks, origin, extent, 0)
    rows, columns, slots = np.nonzero(table >= 0)
    nodes = table[rows, columns, slots]
    centre = origin + 20.0 * (np.stack([columns, rows], axis=-1) + 0.5)
    away = np.hypot(*(one.walks.xyz[nodes, :2] - centre).T)
    assert len(nodes) > 1000 and away.min() > 66.0 and away.max() <= 115.0
    assert not one.walks.is_kerb[nodes].any()


def test_rows_of_two_towns_lie_one_after_another(bundled):
    towns = [bundled["village"], bundled["grid"]]
    rows = road_map_builder.build(towns)
    first = town.offsets(towns)[1].walk
    neighbours, xyz = np.asarray(rows.walk_neighbours), np.asarray(rows.walk_xyz)
    graph = bundled["grid"].walks
    np.testing.assert_allclose(xyz[first:-1], graph.xyz, atol=1e-4)
    shape = graph.neighbours.shape
    want = np.where(graph.neighbours >= 0, graph.neighbours + first, -1)
    np.testing.assert_array_equal(neighbours[first:-1, : shape[1]], want)
    assert (neighbours[:first] < first).all()
    spawns = np.asarray(rows.spawn_walk)
    one, two = np.split(spawns, [int(rows.grid_start[1])])
    assert one.max() < first <= two[two >= 0].min()
    assert spawns.max() < len(xyz) - 1
