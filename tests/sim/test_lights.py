"""Traffic lights: one cycle by hand, and who is green together."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import ARMS, approach, crossing, inner, link, network, signal, straight

from carljax.sim import lane_table, light_table, lights, towns
from carljax.sim.road_network import Controller
from carljax.sim.types import LIGHT_GREEN, LIGHT_RED, LIGHT_YELLOW

STATE = jax.jit(lights.state)
G, Y, R = LIGHT_GREEN, LIGHT_YELLOW, LIGHT_RED


def f32(*values):
    return jnp.asarray(values, jnp.float32)


def test_a_cycle_by_hand():
    # Two lights of a cycle of 30 s. Green 10 s, yellow 3 s, red for the rest.
    times = [0.0, 9.9, 10.1, 12.9, 13.1, 14.9, 15.1, 24.9, 25.1, 27.9, 28.1, 29.9, 30.1]
    first = [G, G, Y, Y, R, R, R, R, R, R, R, R, G]
    second = [R, R, R, R, R, R, G, G, Y, Y, R, R, R]
    np.testing.assert_array_equal(STATE(f32(*times), f32(0.0), f32(30.0)), first)
    np.testing.assert_array_equal(STATE(f32(*times), f32(15.0), f32(30.0)), second)
    assert lights.state(f32(1.0), f32(0.0), f32(30.0)).dtype == jnp.int32


def test_yellow_left_by_hand():
    # 3 s until yellow begins at 10 s, then 3 - (t - 10), 0 from 13 s to the cycle's end.
    times = [0.0, 9.0, 10.0, 11.0, 12.5, 13.0, 20.0, 29.5, 30.0]
    left = jax.jit(lights.yellow_left)(f32(*times), f32(0.0), f32(30.0))
    np.testing.assert_allclose(left, [3, 3, 3, 2, 0.5, 0, 0, 0, 3], atol=1e-5)


def test_any_number_of_cycles_later_nothing_has_changed():
    times = np.arange(0.05, 45.0, 0.1)
    now = STATE(f32(*times), f32(7.5), f32(45.0))
    later = STATE(f32(*(times + 40 * 45.0)), f32(7.5), f32(45.0))
    np.testing.assert_array_equal(now, later)
    assert np.bincount(now).tolist() == [100, 30, 320]  # 10 s, 3 s, 32 s


def tables(net):
    table = lane_table.build(net)
    return table, light_table.build(net, table)


def test_groups_of_a_crossing_take_turns_in_the_order_of_the_file():
    groups = [("north", "south"), ("east",), ("west",)]
    table, found = tables(crossing(dict.fromkeys(ARMS, "light"), groups))
    light = {arm: found.lane_light[table.raw_lane[inner(arm, "left")]] for arm in ARMS}
    assert light["north"] == light["south"] and len(set(light.values())) == 3
    # three slots of 10 + 3 + 2 s
    np.testing.assert_allclose(found.cycle, [45, 45, 45])
    starts = [float(found.start[light[arm]]) for arm in ("north", "east", "west")]
    np.testing.assert_allclose(np.mod(np.diff(starts), 45), [15, 15])
    assert (found.lane_light[[table.raw_lane[approach(arm)] for arm in ARMS]] == -1).all()


def test_the_order_may_come_from_the_controllers_sequence():
    net = crossing(dict.fromkeys(ARMS[:2], "light"))
    sequences = {"a": Controller("a", 7, ("east",)), "b": Controller("b", 2, ("north",))}
    table, found = tables(dataclasses.replace(net, controllers=sequences))
    light = {arm: found.lane_light[table.raw_lane[inner(arm, "left")]] for arm in ARMS[:2]}
    starts = found.start[[light["north"], light["east"]]]
    np.testing.assert_allclose(np.mod(np.diff(starts), 30), [15])  # b before a, one slot apart


def test_lights_without_a_controller_switch_one_by_one():
    table, found = tables(crossing(dict.fromkeys(ARMS, "light")))
    light = [found.lane_light[table.raw_lane[inner(arm, "straight")]] for arm in ARMS]
    assert len(set(light)) == 4
    np.testing.assert_allclose(found.cycle, 60.0)


def test_a_single_light_is_not_green_for_ever():
    table, found = tables(crossing({"east": "light"}))
    np.testing.assert_allclose(found.cycle, [30.0])


def test_a_light_before_the_junction_takes_turns_with_those_inside():
    # The line of one arm lies on its approach, with another piece of road between it and the
    # junction; that of the other arm on the lanes inside.
    lanes = [
        straight((-40, 0), (-20, 0)),
        straight((-20, 0), (-5, 0), speed_limit=5.0),
        straight((-5, 0), (5, 0), junction="9"),
        straight((0, -5), (0, 5), junction="9"),
    ]
    signals = [signal("a", "light", [(0, 18)]), signal("b", "light", [(3, 0)])]
    table, found = tables(network(link(lanes, [(0, 1), (1, 2)]), signals))
    light = found.lane_light[[table.raw_lane[0], table.raw_lane[3]]]
    assert light[0] != light[1]
    np.testing.assert_allclose(found.cycle, [30, 30])
    np.testing.assert_allclose(np.mod(found.start[light[0]] - found.start[light[1]], 30), 15)


def test_a_town_without_lights_still_has_a_table():
    _, found = tables(crossing())
    assert (found.lane_light == -1).all() and len(found.cycle) == len(found.start) == 1


@pytest.mark.parametrize("name", towns.names())
def test_one_group_at_a_time_goes_in_bundled_towns(name, bundled):
    found = bundled[name]
    cycle, start = (f32(*x) for x in (found.lights.cycle, found.lights.start))
    times = np.arange(0.05, max(cycle), 0.1)
    state = np.asarray(STATE(f32(*times)[:, None], start, cycle))  # (T, L)
    lights_of = {}
    for lane in np.flatnonzero(found.lights.lane_light >= 0):
        # the junction of the lane itself or of the first one ahead
        row = int(lane)
        while found.lanes.junction[row] is None:
            row = int(found.lanes.successors[row, 0])
        lights_of.setdefault(found.lanes.junction[row], set()).add(found.lights.lane_light[lane])
    for rows in map(sorted, lights_of.values()):
        period = set(found.lights.cycle[rows])
        assert len(period) == 1
        seen = state[: round(10 * period.pop()), rows]
        assert ((seen != LIGHT_RED).sum(axis=1) <= 1).all()
        np.testing.assert_allclose((seen == LIGHT_GREEN).sum(axis=0), 100, atol=1)  # 10 s each


# Junctions that a scenario holds. Lights 0 and 1 share junction 0 and a cycle of 30 s, green from
# 0 and from 15 s on; light 2 is that of another junction, green from 0 s on.
TABLE = types.SimpleNamespace(
    light_start=f32(0.0, 15.0, 0.0),
    light_cycle=f32(30.0, 30.0, 30.0),
    light_junction=jnp.int32([0, 0, 1]),
)
ALL_LIGHTS = jnp.arange(3)


def held(green, begin, end):
    """At a time, what the three lights show, and their seconds of yellow left."""
    clock = lights.clock(f32(0.0)[0], 2).replace(
        held_junction=jnp.int32([-1, 0]),
        held_green=jnp.int32([[-1, -1], [green, -1]]),
        held_from=f32(-np.inf, begin),
        held_until=f32(-np.inf, end),
    )

    def at(time):
        now = clock.replace(time=jnp.float32(time))
        shown = lights.colour(ALL_LIGHTS, now, TABLE)
        return shown.tolist(), lights.yellow_left_of(ALL_LIGHTS, now, TABLE)

    return at


def test_a_hold_turns_the_others_red_and_then_its_own_green():
    # From 5 s on light 1 is held green. Light 0 was green: 3 s of yellow, then red. Light 1 was
    # red: so it stays for 3 + 2 s, until 10 s, and green after that, beyond its programme (15 to
    # 25 s) too.
    at = held(green=1, begin=5.0, end=np.inf)
    times = [4.9, 5.1, 7.9, 8.1, 9.9, 10.1, 20.0, 26.0, 31.0, 100.0]
    first = [G, Y, Y, R, R, R, R, R, R, R]
    second = [R, R, R, R, R, G, G, G, G, G]
    assert [at(t)[0][0] for t in times] == first
    assert [at(t)[0][1] for t in times] == second
    # The other junction goes on: green 0 to 10, yellow to 13, red to 30 s.
    assert [at(t)[0][2] for t in times] == [G, G, G, G, G, Y, R, R, G, Y]


def test_a_light_that_is_green_when_it_is_held_stays_so():
    at = held(green=0, begin=5.0, end=np.inf)
    assert [at(t)[0][0] for t in (5.1, 8.1, 10.1, 14.0, 99.0)] == [G] * 5
    assert [at(t)[0][1] for t in (5.1, 8.1, 10.1, 16.0, 99.0)] == [R] * 5


def test_a_light_that_is_yellow_when_it_is_held_turns_red_first():
    # Light 0 is yellow from 10 to 13 s; held green from 11 s: yellow to 14 s, red to 16 s.
    at = held(green=0, begin=11.0, end=np.inf)
    assert [at(t)[0][0] for t in (10.9, 11.1, 13.9, 14.1, 15.9, 16.1)] == [Y, Y, Y, R, R, G]
    at = held(green=1, begin=11.0, end=np.inf)
    assert [at(t)[0][0] for t in (10.9, 11.1, 13.9, 14.1, 15.9, 16.1)] == [Y, Y, Y, R, R, R]


def test_a_hold_ends_by_yellow_and_a_moment_of_red():
    # Held green from 5 to 40 s: yellow to 43 s, red to 45 s, then the programme: at 45 s light 1
    # turns green (15 + 30), light 0 at 60 s.
    at = held(green=1, begin=5.0, end=40.0)
    times = [39.9, 40.1, 42.9, 43.1, 44.9, 45.1, 54.9, 55.1, 60.1]
    assert [at(t)[0][1] for t in times] == [G, Y, Y, R, R, G, G, Y, R]
    assert [at(t)[0][0] for t in times] == [R, R, R, R, R, R, R, R, G]


def test_yellow_left_of_a_held_light():
    at = held(green=1, begin=5.0, end=40.0)
    left = [[float(at(t)[1][light]) for t in (5.5, 7.0, 8.5)] for light in (0, 2)]
    np.testing.assert_allclose(left[0], [2.5, 1.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(left[1], [3.0, 3.0, 3.0], atol=1e-5)  # not held, green to 10 s
    left = [float(at(t)[1][1]) for t in (40.5, 42.0, 43.5)]
    np.testing.assert_allclose(left, [2.5, 1.0, 0.0], atol=1e-5)
