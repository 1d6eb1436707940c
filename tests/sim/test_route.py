"""Routes: drawn along the lane graph, with their lines and signs; the window; progress by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import crossing, link, network, road, signal, straight

from carljax.sim import route, town, towns
from carljax.sim.route_generator import RouteError, RouteSizes, draw
from carljax.sim.town import offsets
from carljax.sim.types import STOP_NONE

LENGTH = 1000.0
SIZES = RouteSizes(num_points=1008)
NUM_ROUTES = 6
window, advance, distance = (jax.jit(f) for f in (route.window, route.advance, route.distance))


@pytest.fixture(scope="module", params=towns.names())
def drawn(request, bundled):
    """A bundled town and some routes through it."""
    there = bundled[request.param]
    return there, [draw_in(there, seed) for seed in range(NUM_ROUTES)]


def draw_in(there, seed, length=LENGTH, sizes=SIZES):
    return draw(there, offsets([there])[0], length, sizes, np.random.default_rng(seed))


def valid(found, name):
    return np.asarray(getattr(found, name), float)[: int(found.num_points)]


def lanes(found):
    return valid(found, "lane").astype(int), valid(found, "lane_s")


def is_change(table, lane, i):
    """Whether point i lies on a neighbour of the lane of point i - 1."""
    return lane[i] != lane[i - 1] and lane[i] not in table.successors[lane[i - 1]]


def test_routes_have_the_wanted_length_and_a_point_each_metre(drawn):
    table = drawn[0].lanes
    for found in drawn[1]:
        lane, _ = lanes(found)
        assert found.num_points == LENGTH + 1
        xy, s = valid(found, "xy"), valid(found, "s")
        step = np.hypot(*np.diff(xy, axis=0).T)
        np.testing.assert_allclose(np.diff(s), step, atol=1e-3)
        assert float(found.length) == pytest.approx(s[-1])
        changes = np.array([is_change(table, lane, i) for i in range(1, len(lane))])
        # In a bend of radius 8 m the chord of 1 m is 1 - 1 / (24 * 64): 0.7 mm shorter; the lane's
        # own points cut its corners too.
        np.testing.assert_allclose(step[~changes], 1.0, atol=0.02)
        # A change is 1 m on and a lane's width, 2.5 to 4.5 m, aside.
        assert ((step[changes] > 2.5) & (step[changes] < 4.7)).all()


def test_routes_follow_the_lane_graph(drawn):
    there, table = drawn[0], drawn[0].lanes
    for found in drawn[1]:
        lane, s = lanes(found)
        assert (s >= 0).all() and (s <= table.length[lane] + 1e-4).all()
        for i in range(1, len(lane)):
            if lane[i] == lane[i - 1]:
                assert abs(s[i] - s[i - 1] - 1.0) < 1e-3
            elif not is_change(table, lane, i):
                left = table.length[lane[i - 1]] - s[i - 1]
                assert abs(left + s[i] - 1.0) < 1e-3
            else:
                assert table.junction[lane[i]] is None and table.junction[lane[i - 1]] is None
                assert neighbours(there, lane[i - 1], s[i - 1], lane[i])


def neighbours(there, a, s, b):
    """Whether lane b has a raw lane next to that of lane a at s, in the same direction."""
    starts = there.lanes.raw_start[there.lanes.members[a]]
    # the raw lane at s, or the next one if the change came within the metre between two points
    for at in (s, s + 1.0):
        raw = there.lanes.members[a][int(np.flatnonzero(starts <= at)[-1])]
        here = there.network.lanes[raw]
        for side, same in (
            (here.left, here.left_is_same_direction),
            (here.right, here.right_is_same_direction),
        ):
            if side >= 0 and same and there.lanes.raw_lane[side] == b:
                return True
    return False


def test_lane_changes_are_200_m_apart(bundled):
    there = bundled["highway"]
    num = 0
    for seed in range(NUM_ROUTES):
        lane, _ = lanes(draw_in(there, seed))
        at = [i for i in range(1, len(lane)) if is_change(there.lanes, lane, i)]
        num += len(at)
        assert (np.diff(at) >= 200 - 1).all()
    assert num > NUM_ROUTES  # more than one in 1 km of dual carriageway


def passings(table, lane, s, places):
    """(point, what) for each (lane, s, what) passed, found point by point."""
    on = {}
    for row, at, what in places:
        on.setdefault(int(row), []).append((at, what))
    out = [(0, what) for at, what in on.get(lane[0], []) if abs(at - s[0]) < 1e-4]
    for i in range(1, len(lane)):
        here = (lane[i], s[i - 1] if lane[i] == lane[i - 1] else -1.0, s[i])
        rest = (lane[i - 1], s[i - 1], np.inf)
        if lane[i] == lane[i - 1]:
            stretches = [here]
        elif is_change(table, lane, i):
            stretches = [(lane[i], s[i] - 1.0, s[i])]
        else:
            stretches = [rest, here]
        for row, after, upto in stretches:
            found = [w for at, w in on.get(row, []) if after + 1e-4 < at <= upto + 1e-4]
            out += [(i, what) for what in found]
    return out


def test_stop_lines_are_those_of_the_lanes_in_order(drawn):
    table, lights = drawn[0].lanes, drawn[0].lights
    held = np.flatnonzero(table.stop_kind != STOP_NONE)
    for found in drawn[1]:
        expected = passings(table, *lanes(found), [(row, table.stop_s[row], row) for row in held])
        num = len(expected)
        assert found.stop_idx[:num].tolist() == [i for i, _ in expected]
        assert (found.stop_idx[num:] == -1).all()
        assert (found.stop_kind[num:] == STOP_NONE).all()
        for slot, (i, row) in enumerate(expected):
            assert found.stop_kind[slot] == table.stop_kind[row]
            assert found.stop_light[slot] == lights.lane_light[row]
            # The line itself, up to a metre before the first point beyond it.
            points = table.point_xyz[table.points(row)]
            along = np.linspace(0, table.length[row], len(points))
            xy = [np.interp(table.stop_s[row], along, points[:, k]) for k in range(2)]
            np.testing.assert_allclose(found.stop_xy[slot], xy, atol=1e-4)
            beyond = found.xy[i] - found.stop_xy[slot]
            heading = [np.cos(found.stop_yaw[slot]), np.sin(found.stop_yaw[slot])]
            assert -1e-3 <= beyond @ heading <= 1.0 + 1e-3
            assert -1e-3 <= found.s[i] - found.stop_s[slot] <= 1.0 + 1e-3


def test_signs_and_limits(drawn):
    there, table = drawn[0], drawn[0].lanes
    signs = [sign for sign in there.network.signals if sign.kind == "speed"]
    places = [(table.place(g.lane, g.distance), sign) for sign in signs for g in sign.governed]
    places = [(place.lane, place.s, sign) for place, sign in places]
    num_signs = 0
    for found in drawn[1]:
        lane, s = lanes(found)
        expected = passings(table, lane, s, places)
        num = len(expected)
        assert found.sign_idx[:num].tolist() == [i for i, _ in expected]
        assert (found.sign_idx[num:] == -1).all()
        limit = np.full(len(lane), 30 / 3.6)
        for slot, (i, sign) in enumerate(expected):
            limit[i:] = sign.value
            np.testing.assert_allclose(found.sign_xy[slot], sign.xyz[:2], atol=1e-4)
            assert found.sign_limit[slot] == pytest.approx(sign.value)
        np.testing.assert_allclose(valid(found, "speed_limit"), limit, rtol=1e-6)
        num_signs += num
    assert num_signs > NUM_ROUTES


def test_a_town_without_signs_has_its_lanes_limits():
    there = town.from_network(road(0, 100, 400))
    found = draw_in(there, 0, length=50.0, sizes=RouteSizes(60))
    np.testing.assert_allclose(found.speed_limit, 10.0)


def ring(*distances, sign_at):
    """A square ring in four lanes that are kept apart by their limits, with a sign and a line."""
    corners = [(0, 0), (100, 0), (100, 100), (0, 100)]
    sides = [
        straight(corners[k], corners[(k + 1) % 4], speed_limit=10.0 + k, road_id=str(k))
        for k in range(4)
    ]
    links = [(k, (k + 1) % 4) for k in range(4)]
    signals = [signal(f"line {d}", "stop", [(k, d)]) for k, d in enumerate(distances)]
    signals.append(signal("sign", "speed", [(2, sign_at)], value=7.0))
    return town.from_network(network(link(sides, links), signals, name="ring"))


@pytest.mark.parametrize("distance", [0.0, 0.3, 99.6, 99.95, 100.0])
def test_lines_and_signs_at_a_lanes_ends_are_not_missed(distance):
    # Route points are 1 m apart, so that there may be none on a lane's last metre.
    there = ring(distance, distance, distance, distance, sign_at=distance)
    for seed in range(8):
        found = draw_in(there, seed, length=400.0, sizes=RouteSizes(410))
        assert (found.stop_idx >= 0).sum() in (4, 5)
        assert (found.sign_idx >= 0).sum() in (1, 2)
        np.testing.assert_allclose(np.diff(found.stop_s[:4]), 100.0, atol=0.5)


def test_the_same_seed_gives_the_same_route_and_another_seed_another(drawn):
    there, found = drawn
    again = draw_in(there, 0)
    jax.tree.map(np.testing.assert_array_equal, again, found[0])
    assert len({f.xy.tobytes() for f in found}) == NUM_ROUTES


def test_a_longer_town_table_shifts_the_rows(bundled):
    there = bundled["grid"]
    first = offsets([there, there])[1]
    alone, beside = draw_in(there, 5), draw(there, first, LENGTH, SIZES, np.random.default_rng(5))
    np.testing.assert_array_equal(beside.xy, alone.xy)
    np.testing.assert_array_equal(beside.lane - alone.lane, len(there.lanes.length))
    has = alone.stop_light >= 0
    assert has.any() and beside.town == 1
    np.testing.assert_array_equal((beside.stop_light - alone.stop_light)[has], first.light)
    assert (beside.stop_light[~has] == -1).all()


@pytest.mark.parametrize("net", [crossing(), road(0, 100, name="lane of 100 m")])
def test_a_town_too_small_fails_by_name(net):
    with pytest.raises(RouteError, match=f"^{net.name}: no route of 300 m"):
        draw_in(town.from_network(net), 0, length=300.0, sizes=RouteSizes(310))


def test_routes_with_more_lines_than_there_is_room_for_are_not_taken():
    there = ring(50, 50, 50, 50, sign_at=50)
    with pytest.raises(RouteError, match="ring"):
        draw_in(there, 0, length=400.0, sizes=RouteSizes(410, num_stops=3))


@pytest.fixture(scope="module")
def stacked(bundled):
    found = [draw_in(bundled["grid"], seed) for seed in range(3)]
    return jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *found)


@pytest.mark.parametrize(
    ("idx", "start"),
    # the window begins 24 points back, within [0, 1008 - 176]
    [(0, 0), (24, 0), (25, 1), (400, 376), (856, 832), (857, 832), (1000, 832)],
)
def test_window_is_a_slice(stacked, idx, start):
    part, first = window(stacked, jnp.int32(2), jnp.int32(idx))
    assert int(first) == start
    for name in ("xy", "yaw", "s", "lane", "lane_s", "speed_limit", "in_junction"):
        rows = np.asarray(getattr(stacked, name))[2, start : start + 176]
        np.testing.assert_array_equal(getattr(part, name), rows)
    assert int(part.num_points) == 1001 - start
    for name in ("stop_idx", "sign_idx"):
        whole, moved = np.asarray(getattr(stacked, name))[2], np.asarray(getattr(part, name))
        np.testing.assert_array_equal(moved[whole >= 0], whole[whole >= 0] - start)
        assert (moved[whole < 0] < -1000).all()  # never taken for a point nearby
    for name in ("stop_xy", "stop_kind", "stop_light", "stop_s", "sign_xy", "length", "town"):
        np.testing.assert_array_equal(getattr(part, name), np.asarray(getattr(stacked, name))[2])


def line_of_points(xy, yaw=0.0):
    """A route with nothing but points."""
    num = len(xy)
    fields = dict.fromkeys(route.Route.__dataclass_fields__, jnp.zeros(()))
    fields["xy"] = jnp.asarray(xy, jnp.float32)
    fields["yaw"] = jnp.broadcast_to(jnp.asarray(yaw, jnp.float32), num)
    fields["num_points"] = jnp.int32(num)
    return route.Route(**fields)


EAST = line_of_points([(x, 0.0) for x in range(10)])


@pytest.mark.parametrize(
    ("idx", "xy", "expected"),
    [
        (0, (0.5, 0.0), 0),
        (0, (1.2, 0.0), 1),
        (0, (1.2, -3.0), 1),  # beside the route too
        (0, (2.1, 0.0), 2),
        (0, (9.0, 0.0), 2),  # at most two points a step
        (3, (0.5, 0.0), 3),  # never back
        (7, (9.5, 0.0), 9),
        (8, (9.5, 0.0), 9),
        (9, (20.0, 0.0), 9),  # the last one stays
    ],
)
def test_advance_by_hand(idx, xy, expected):
    got = advance(EAST, jnp.int32(idx), jnp.asarray(xy, jnp.float32))
    assert int(got) == expected and got.dtype == jnp.int32


def test_advance_looks_along_each_points_own_direction():
    # A right angle to the left at (2, 0): a car at (2.5, 0.2) has passed the corner only.
    bend = line_of_points(
        [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2)], [0, 0, np.pi / 4, np.pi / 2, np.pi / 2]
    )
    at = jnp.asarray((2.5, 0.2), jnp.float32)
    assert int(advance(bend, jnp.int32(1), at)) == 2
    assert int(advance(bend, jnp.int32(2), at)) == 2


@pytest.mark.parametrize(
    ("idx", "xy", "expected"),
    [
        (0, (2.0, 3.0), 3.0),
        (0, (5.0, 0.0), 0.0),  # the current point and the next five
        (0, (9.0, 0.0), 4.0),
        (4, (0.0, 3.0), 5.0),
        (8, (13.0, 3.0), 5.0),  # fewer are left: the last is (9, 0)
    ],
)
def test_distance_by_hand(idx, xy, expected):
    got = distance(EAST, jnp.int32(idx), jnp.asarray(xy, jnp.float32))
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_lane_changes_only_where_the_paint_allows_one(bundled):
    there = bundled["highway"]
    table, num = there.lanes, 0
    for seed in range(NUM_ROUTES):
        lane, s = lanes(draw_in(there, seed))
        for i in range(1, len(lane)):
            if is_change(table, lane, i):
                spacing = table.length[lane[i - 1]] / (table.num_points[lane[i - 1]] - 1)
                # the change lies within the metre after the point before it
                rows = table.start[lane[i - 1]] + np.rint((s[i - 1] + np.array([0, 1])) / spacing)
                beside = [side[rows.astype(int)] for side in vars(there.neighbours).values()]
                assert (table.point_lane[np.concatenate(beside)] == lane[i]).any()
                num += 1
    assert num > NUM_ROUTES


def test_no_route_begins_on_a_lane_too_narrow_for_a_car():
    wide = straight((0, 0), (100, 0))
    opening = dataclasses.replace(wide, width=np.clip(wide.xyz[:, 0] / 20.0, 0.0, 3.5))
    there = town.from_network(network([opening]))
    for seed in range(30):
        found = draw_in(there, seed, length=20.0, sizes=RouteSizes(30))
        # 2.5 m are reached at x = 50; the town's middle is there too
        assert found.xy[0, 0] >= -0.5
