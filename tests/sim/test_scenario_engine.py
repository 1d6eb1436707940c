"""The scenario engine, step by step, on a straight road where everything can be worked out.

The road runs east from x = 0 to x = 400 and is one lane wide, so arc lengths on the route are x. An
ego at x sees from x - 52 to x + 80 m, and 66 m to the sides.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import road
from traffic_world import make_ego

from carljax.sim import lights, population, road_map_builder, town
from carljax.sim.population import Population
from carljax.sim.right_of_way import EgoPlace
from carljax.sim.scenarios import engine, script
from carljax.sim.scenarios.actors import Scene
from carljax.sim.scenarios.script import DRIVE_FLOW, DRIVE_LEGAL, DRIVE_MEET, NUM_CARS, NUM_OTHERS
from carljax.sim.types import (
    KIND_NONE,
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    SIGNAL_EMERGENCY,
    SIGNAL_LEFT,
)

DT = 0.1
MIDDLE = 200.0  # x of the road's middle, which the town moves to the origin
ROWS = Population(num_traffic=3, num_slots=2, num_walkers=1)
CAR, OTHER = ROWS.cars.start, ROWS.others.start  # first rows of the first slot


@pytest.fixture(scope="module")
def road_map():
    # Three lanes one after another: 0 to 200 m, to 300 m, to 400 m, with limits of their own.
    found = road(0, 200, 300, 400)
    pieces = tuple(
        dataclasses.replace(lane, speed_limit=10.0 + k) for k, lane in enumerate(found.lanes)
    )
    return road_map_builder.build([town.from_network(dataclasses.replace(found, lanes=pieces))])


def scene(road_map, x, speed, is_start=False):
    ego = make_ego((x - MIDDLE, 0.0), 0.0, speed)
    lane = jnp.int32((x >= 200.0) + (x >= 300.0))
    start = jnp.float32([0.0, 200.0, 300.0])[lane]
    place = EgoPlace(lane=lane, next_lane=lane + 1, s=ego.xy[0] + MIDDLE - start)
    return Scene(ego, jnp.float32(4.9), place, jnp.float32(x), road_map, is_start, ROWS)


@jax.jit
def _step(state, scenarios, road_map, x, speed, key):
    slots, agents, clock = state
    clock = clock.replace(time=clock.time + DT)
    at = scene(road_map, x, speed)
    return engine.step(slots, agents, clock, scenarios, jnp.int32(0), at, key, DT)


@jax.jit
def _start(agents, scenarios, road_map, key):
    slots = script.empty_slots(ROWS.num_slots)
    at = scene(road_map, 0.0, 0.0, is_start=True)
    return engine.start(slots, agents, scenarios, jnp.int32(0), at, key)


def route(*changes):
    """The scenarios of one route (1, E): each a dict of fields, those of actors as lists."""
    num = len(changes)
    found = script.nothing(num)
    for i, fields in enumerate(changes):
        found.kind[i] = i
        for name, value in fields.items():
            if name in ("cars", "others"):
                for column, entries in value.items():
                    values = np.asarray(entries)
                    part = (i, *(slice(0, size) for size in values.shape))
                    getattr(getattr(found, name), column)[part] = values
            else:
                getattr(found, name)[i] = value
    return jax.tree.map(lambda x: jnp.asarray(x)[None], found)


def walker(x, y=-5.0, **fields):
    """Columns of one pedestrian who stands at (x, y) and looks across the road."""
    return {
        "kind": [KIND_PEDESTRIAN],
        "xy": [(x - MIDDLE, y)],
        "yaw": [np.pi / 2],
        "length": [0.5],
        "width": [0.5],
        "meet_s": [x],
    } | {name: [value] for name, value in fields.items()}


PLAIN = {"arm_s": 20.0, "trigger_s": 60.0, "end_s": 150.0, "timeout_s": 30.0}


class World:
    """A route with scenarios and an ego that is put where the test wants it."""

    def __init__(self, road_map, *scenarios, at_start=False):
        self.map, self.scenarios = road_map, route(*scenarios)
        self.agents = jax.tree.map(np.array, population.nobody(ROWS.num_agents))
        self.slots = script.empty_slots(ROWS.num_slots)
        self.clock = lights.clock(jnp.float32(100.0), ROWS.num_slots)
        self.key = jax.random.key(0)
        if at_start:
            self.start()

    def start(self):
        """Begins the episode anew, with the vehicles that are there."""
        state = _start(self.agents, self.scenarios, self.map, self.key)
        self.slots, self.agents = jax.tree.map(np.array, state)

    def at(self, x, speed=10.0, steps=1):
        """Plays with the ego at x."""
        for _ in range(steps):
            self.key, key = jax.random.split(self.key)
            state = (self.slots, self.agents, self.clock)
            state = _step(state, self.scenarios, self.map, x, speed, key)
            self.slots, self.agents, self.clock = jax.tree.map(np.array, state)
        return self

    def put(self, row, x, y=0.0, **fields):
        """Puts a vehicle into a row, on the lane at x."""
        lane = int(x >= 200) + int(x >= 300)
        values = {
            "kind": KIND_VEHICLE,
            "xy": (x - MIDDLE, y),
            "length": 4.0,
            "width": 2.0,
            "lanes": (lane, lane + 1 if lane < 2 else -1, -1),
            "lane_s": x - (0.0, 200.0, 300.0)[lane],
        } | fields
        for name, value in values.items():
            getattr(self.agents, name)[row] = value
        return self

    def x(self, row):
        """Where an agent is, m."""
        return float(self.agents.xy[row, 0]) + MIDDLE

    def kinds(self, row, num=1):
        """Kinds of agents in consecutive rows."""
        return self.agents.kind[row : row + num].tolist()


# Arming


def test_actors_take_their_places_where_the_scenario_is_armed(road_map):
    others = {
        "kind": [KIND_PEDESTRIAN, KIND_STATIC],
        "xy": [(-40.0, -5.0), (-42.0, -5.0)],
        "z": [1.0, 2.0],
        "yaw": [1.5, 0.0],
        "length": [0.5, 1.0],
        "width": [0.6, 1.1],
    }
    cars = {"model": [0], "lanes": [(0, 1, 2)], "s": [150.0], "speed": [7.0]}
    world = World(road_map, PLAIN | {"others": others, "cars": cars})
    world.at(19.9)
    assert not world.agents.valid.any() and world.slots.index.tolist() == [-1, -1]
    world.at(20.1)
    assert world.slots.index.tolist() == [0, -1] and world.slots.next_index == 1
    assert world.slots.is_armed.tolist() == [True, False] and not world.slots.is_playing.any()
    assert world.kinds(OTHER, NUM_OTHERS) == [KIND_PEDESTRIAN, KIND_STATIC, KIND_NONE]
    assert world.kinds(CAR, NUM_CARS) == [KIND_VEHICLE, *[KIND_NONE] * 3]
    there = jax.tree.map(lambda x: np.asarray(x[OTHER : OTHER + 2]), world.agents)
    np.testing.assert_allclose(there.xy, others["xy"])
    for name in ("z", "yaw", "length", "width"):
        np.testing.assert_allclose(getattr(there, name), others[name])
    assert (there.speed == 0).all()
    # x = 150 on a road whose middle, 200, is the origin
    np.testing.assert_allclose(world.agents.xy[CAR], (-50.0, 0.0), atol=1e-4)
    assert world.agents.lanes[CAR].tolist() == [0, 1, 2] and world.agents.lane_s[CAR] == 150
    assert world.agents.speed[CAR] == 7 and world.agents.cruise_speed[CAR] == 7
    assert not world.agents.is_lawless[CAR]
    assert world.agents.length[CAR] == 4.5 and world.agents.width[CAR] == 2.0  # middle of a car's


@pytest.mark.parametrize(
    ("x", "y", "comes"), [(79, -5, True), (81, -5, False), (81, -65, False), (81, -67, True)]
)
def test_nobody_appears_in_sight(road_map, x, y, comes):
    # At x = 160: 81 or 79 m ahead, and 65 or 67 m aside.
    world = World(road_map, PLAIN | {"trigger_s": 300.0, "others": walker(160.0, y)}).at(x)
    assert bool(world.agents.valid.any()) == comes


def test_a_scenario_waits_to_be_out_of_sight_and_is_left_out_after_its_trigger(road_map):
    seen = PLAIN | {"others": walker(90.0)}  # 70 m ahead of where it should be armed
    after = PLAIN | {"arm_s": 30.0, "trigger_s": 80.0, "others": walker(170.0)}
    world = World(road_map, seen, after)
    world.at(20.0, steps=3)
    assert world.slots.next_index == 0 and not world.agents.valid.any()
    world.at(5.0)  # 85 m away, but not yet at arm_s
    assert not world.agents.valid.any()
    world.at(62.0)
    assert world.slots.next_index == 0  # just passed: still in time
    world.at(63.5)
    assert world.slots.next_index == 1 and not world.agents.valid.any()
    world.at(63.5)
    assert world.slots.next_index == 2 and world.slots.index.tolist() == [1, -1]
    assert world.slots.num_triggered == 0
    assert world.x(OTHER) == 170.0


def test_a_scenario_waits_for_its_place(road_map):
    world = World(road_map, PLAIN | {"others": walker(160.0)})
    # Its box ends 0.25 m to the front; a car of 4 m is clear from 2 + 0.25 + 0.5 m on.
    world.put(0, 160.0, y=-7.6).at(25.0)
    assert world.slots.next_index == 0
    world.put(0, 160.0, y=-7.8).at(25.0)
    assert world.slots.next_index == 1 and world.kinds(OTHER) == [KIND_PEDESTRIAN]


def test_a_car_needs_room_before_and_behind(road_map):
    cars = {"model": [0], "lanes": [(0, 1, 2)], "s": [150.0]}
    # 2.25 m of its own length, 2 m of the other's and 9 m between them
    for x, comes in ((150.0 - 13.0, False), (150.0 - 13.5, True), (150.0 + 13.0, False)):
        world = World(road_map, PLAIN | {"cars": cars}).put(0, x).at(25.0)
        assert (world.kinds(CAR) == [KIND_VEHICLE]) == comes
        assert world.slots.next_index == comes
    # without a speed of its own it begins at the limit
    assert World(road_map, PLAIN | {"cars": cars}).at(25.0).agents.speed[CAR] == 10.0


def test_at_the_start_whoever_is_near_may_appear_in_sight(road_map):
    near = PLAIN | {"arm_s": 0.0, "trigger_s": 10.0, "others": walker(30.0)}
    second = PLAIN | {"arm_s": 0.0, "trigger_s": 40.0, "others": walker(60.0)}
    third = PLAIN | {"arm_s": 0.0, "trigger_s": 50.0, "others": walker(70.0)}
    world = World(road_map, near, second, third, at_start=True)
    assert world.slots.index.tolist() == [0, 1] and world.slots.next_index == 2
    assert [world.x(OTHER), world.x(OTHER + 1)] == [30.0, 60.0]
    occupied = World(road_map, near).put(0, 30.0, y=-5.0)
    occupied.start()
    assert occupied.slots.next_index == 0


def test_scenarios_share_the_rows_of_cars(road_map):
    def cars(num):
        # At the trigger, and far from one another and from the ego.
        return {
            "model": [0] * num,
            "lanes": [(2, -1, -1)] * num,
            "s": [20.0 * k for k in range(num)],
            "from_trigger": [True] * num,
        }

    plain = {"arm_s": 20.0, "end_s": 70.0, "timeout_s": 30.0}
    first = plain | {"trigger_s": 30.0, "cars": cars(4)}
    small = plain | {"trigger_s": 400.0, "end_s": 450.0, "cars": cars(2)}
    large = plain | {"trigger_s": 400.0, "end_s": 450.0, "cars": cars(3)}
    world = World(road_map, first, small).at(25.0, steps=2)
    assert world.slots.cars.slot.tolist() == [0, 0, 0, 0, 1, 1]
    assert world.slots.cars.number.tolist() == [0, 1, 2, 3, 0, 1]
    world = World(road_map, first, large).at(25.0, steps=2)
    assert world.slots.index.tolist() == [0, -1] and world.slots.next_index == 1  # 2 rows for 3
    world.at(35.0, steps=4)
    assert world.kinds(CAR, 6) == [KIND_VEHICLE] * 4 + [KIND_NONE] * 2
    world.at(71.0, steps=2)  # over; nobody sees the cars beyond 300 m
    assert world.slots.index.tolist() == [1, -1]
    assert (world.slots.cars.slot >= 0).sum() == 3
    assert world.kinds(CAR, 6) == [KIND_NONE] * 6  # those of the second come at its trigger


def test_scenarios_share_the_rows_of_others(road_map):
    def others(*places):
        columns = [walker(x) for x in places]
        return {name: [column[name][0] for column in columns] for name in columns[0]}

    first = PLAIN | {"others": others(110.0, 120.0, 130.0)}
    small = PLAIN | {"others": others(150.0)}
    large = PLAIN | {"others": others(150.0, 160.0)}
    world = World(road_map, first, small).at(25.0, steps=2)
    assert world.slots.others.slot.tolist() == [0, 0, 0, 1]
    assert [world.x(OTHER + k) for k in range(4)] == [110.0, 120.0, 130.0, 150.0]
    world = World(road_map, first, large).at(25.0, steps=2)
    assert world.slots.index.tolist() == [0, -1] and world.slots.next_index == 1  # 1 row for 2
    assert world.kinds(OTHER, 4) == [KIND_PEDESTRIAN] * 3 + [KIND_NONE]


def test_a_full_house_waits_and_then_takes_over_who_is_leaving(road_map):
    plain = {"arm_s": 20.0, "end_s": 70.0, "timeout_s": 30.0}
    world = World(
        road_map,
        plain | {"trigger_s": 30.0, "others": walker(110.0)},
        plain | {"trigger_s": 300.0, "end_s": 350.0, "others": walker(120.0)},
        plain | {"trigger_s": 300.0, "end_s": 350.0, "others": walker(180.0)},
    )
    world.at(25.0, steps=3)
    assert world.slots.index.tolist() == [0, 1] and world.slots.next_index == 2
    world.at(35.0).at(71.0)
    assert world.slots.is_leaving.tolist() == [True, False]  # 110 is in sight of 71
    assert world.slots.next_index == 2
    world.at(72.0)
    assert world.slots.index.tolist() == [2, 1] and not world.slots.is_leaving.any()
    assert [world.x(OTHER), world.x(OTHER + 1)] == [180.0, 120.0]


# Playing


def test_others_start_in_time_move_and_stand(road_map):
    fields = {"speed": 2.0, "distance": 3.0, "start_time": 1.5, "signals": SIGNAL_LEFT}
    world = World(road_map, PLAIN | {"others": walker(120.0, **fields)})
    world.at(25.0)
    world.at(110.0 - 50.1, speed=40.0)  # 1.5 s away, but not yet triggered
    assert not world.slots.has_started.any()
    # 1.5 s at 10 m/s are 15 m
    world.at(104.9, speed=10.0)
    assert world.slots.is_playing.tolist() == [True, False] and world.slots.num_triggered == 1
    assert not world.slots.has_started.any() and world.agents.signals[OTHER] == 0
    world.at(105.1, speed=10.0)
    assert world.slots.has_started.tolist() == [True, False, False, False]
    np.testing.assert_allclose(world.agents.xy[OTHER], (-80.0, -4.8), atol=1e-4)  # 0.2 m on
    assert world.agents.speed[OTHER] == 2.0 and world.agents.signals[OTHER] == SIGNAL_LEFT
    world.at(106.0, speed=0.0, steps=9)  # it goes on whatever the ego does: 10 steps are 2 m
    np.testing.assert_allclose(world.agents.xy[OTHER, 1], -3.0, atol=1e-4)
    world.at(106.0, speed=0.0, steps=10)  # 3 m and no farther
    np.testing.assert_allclose(world.agents.xy[OTHER], (-80.0, -2.0), atol=1e-4)
    assert world.agents.speed[OTHER] == 0.0


def test_others_start_when_the_ego_is_near_or_stands(road_map):
    fields = {"speed": 2.0, "distance": 3.0, "start_time": 1.5, "start_distance": 6.0}
    world = World(road_map, PLAIN | {"others": walker(120.0, **fields)}).at(25.0)
    world.at(113.9, speed=0.0)  # 6.1 m: at 0.5 m/s, the least, 12 s
    assert not world.slots.has_started.any()
    world.at(114.1, speed=0.0)
    assert world.slots.has_started[0]


def test_whoever_is_struck_from_the_list_does_not_come_back(road_map):
    cars = {"model": [0], "lanes": [(0, 1, 2)], "s": [150.0], "speed": [7.0]}
    others = walker(160.0, speed=2.0, distance=9.0, start_time=99.0)
    world = World(road_map, PLAIN | {"others": others, "cars": cars}).at(25.0)
    world.agents.kind[:] = KIND_NONE
    world.at(70.0, steps=3)
    assert not world.agents.valid.any() and (world.agents.speed[OTHER:] == 0).all()


def test_lights_are_held_from_the_trigger_to_the_end(road_map):
    world = World(road_map, PLAIN | {"held_junction": 3, "held_green": (5, -1)})
    world.at(25.0)
    assert world.clock.held_junction.tolist() == [-1, -1]
    world.at(60.0)
    # the clock was at 100 s and two steps have passed
    assert world.clock.held_junction.tolist() == [3, -1]
    assert world.clock.held_green[0].tolist() == [5, -1]
    np.testing.assert_allclose(world.clock.held_from[0], 100.2, atol=1e-3)
    assert world.clock.held_until.tolist() == [np.inf, -np.inf]
    world.at(151.0)
    np.testing.assert_allclose(world.clock.held_until[0], 100.3, atol=1e-3)
    world.at(152.0, steps=3)
    np.testing.assert_allclose(world.clock.held_until[0], 100.3, atol=1e-3)


def test_it_ends_behind_the_ego_and_frees_its_slot(road_map):
    world = World(road_map, PLAIN | {"others": walker(120.0)}).at(25.0).at(60.0).at(149.9)
    assert world.slots.ended_kind == -1
    world.at(150.1)
    assert world.slots.ended_kind == 0 and not world.slots.has_timed_out
    # 120 is in sight of 150 (52 m back): it is there until it is not
    assert world.slots.is_leaving.tolist() == [True, False] and world.slots.index[0] == 0
    assert not world.slots.is_playing.any() and world.kinds(OTHER) == [KIND_PEDESTRIAN]
    world.at(171.9)
    assert world.slots.ended_kind == -1 and world.kinds(OTHER) == [KIND_PEDESTRIAN]
    world.at(172.1)
    assert world.slots.index.tolist() == [-1, -1] and not world.slots.is_leaving.any()
    assert world.kinds(OTHER) == [KIND_NONE]


def test_time_runs_out_once(road_map):
    world = World(road_map, PLAIN | {"timeout_s": 0.55}).at(25.0).at(60.0).at(60.0, steps=5)
    assert world.slots.ended_kind == -1  # 0.5 s after the trigger
    world.at(60.0)
    assert world.slots.ended_kind == 0 and world.slots.has_timed_out
    assert world.slots.index.tolist() == [-1, -1]
    world.at(60.0)
    assert world.slots.ended_kind == -1 and not world.slots.has_timed_out


def test_of_two_that_end_together_one_is_told_after_the_other(road_map):
    world = World(road_map, PLAIN, PLAIN).at(25.0, steps=2).at(60.0)
    assert world.slots.num_triggered == 2
    assert [int(world.at(151.0).slots.ended_kind) for _ in range(3)] == [0, 1, -1]


@pytest.mark.parametrize(("behind", "fails"), [(20.0, True), (-20.0, False)])
def test_an_emergency_vehicle_is_to_be_let_past(road_map, behind, fails):
    cars = {"model": [0], "lanes": [(0, 1, 2)], "s": [190.0], "signals": [SIGNAL_EMERGENCY]}
    world = World(road_map, PLAIN | {"cars": cars}).at(25.0).at(60.0)
    world.put(CAR, 151.0 - behind).at(151.0)
    assert world.slots.ended_kind == 0 and bool(world.slots.has_failed_to_yield) == fails
    assert world.agents.signals[CAR] & SIGNAL_EMERGENCY
    assert not world.at(151.0).slots.has_failed_to_yield


# Cars


def test_lawless_cars_drive_as_others_once_it_is_over(road_map):
    cars = {
        "model": [0, 0],
        "lanes": [(0, 1, 2)] * 2,
        "s": [150.0, 180.0],
        "speed": [7.0, 8.0],
        "drive": [DRIVE_FLOW, DRIVE_LEGAL],
    }
    world = World(road_map, PLAIN | {"cars": cars}).at(25.0).at(60.0)
    assert world.agents.is_lawless[CAR : CAR + 2].tolist() == [True, False]
    assert world.agents.cruise_speed[CAR : CAR + 2].tolist() == [7.0, 8.0]
    world.at(151.0)
    assert world.kinds(CAR, 2) == [KIND_VEHICLE] * 2
    assert not world.agents.is_lawless.any() and not world.agents.cruise_speed.any()


def test_a_stream_leaves_its_source_car_by_car_and_comes_again(road_map):
    cars = {
        "model": [0] * 3,
        "lanes": [(0, 1, 2)] * 3,
        "s": [190.0] * 3,
        "speed": [10.0] * 3,
        "drive": [DRIVE_FLOW] * 3,
        "travel": [220.0] * 3,
        "from_trigger": [True] * 3,
        "delay": [0.0, 0.0, 0.35],
    }
    world = World(road_map, PLAIN | {"cars": cars}).at(25.0)
    assert world.slots.index[0] == 0 and not world.agents.valid.any()
    world.at(60.0)
    assert world.kinds(CAR, 3) == [KIND_VEHICLE, KIND_NONE, KIND_NONE]  # one at a time
    # 4.5 m of length and 9 m between them: room for the second when the first is at 204 m.
    world.put(CAR, 203.0).at(60.0)
    assert world.kinds(CAR, 3) == [KIND_VEHICLE, KIND_NONE, KIND_NONE]
    world.put(CAR, 204.0).at(60.0)
    assert world.kinds(CAR, 3) == [KIND_VEHICLE, KIND_VEHICLE, KIND_NONE]
    # There is room for the third now, but 0.3 s after the trigger it is not yet its turn.
    world.put(CAR, 219.0).put(CAR + 1, 205.0).at(60.0)
    assert world.kinds(CAR, 3) == [KIND_VEHICLE, KIND_VEHICLE, KIND_NONE]
    assert world.agents.is_lawless[CAR : CAR + 3].tolist() == [True, True, False]
    world.at(60.0)
    assert world.kinds(CAR, 3) == [KIND_VEHICLE] * 3 and world.agents.lane_s[CAR + 2] == 190.0
    # Beyond 220 m the first is one of the others, until its source is free again.
    world.put(CAR, 221.0).at(60.0)
    assert world.agents.is_lawless[CAR : CAR + 3].tolist() == [False, True, True]
    assert world.agents.cruise_speed[CAR] == 0 and world.agents.lane_s[CAR] == 21.0
    world.put(CAR + 2, 204.0).at(60.0)
    assert world.agents.lane_s[CAR] == 190.0 and world.agents.lanes[CAR].tolist() == [0, 1, 2]
    assert world.agents.is_lawless[CAR] and world.agents.cruise_speed[CAR] == 10.0


@pytest.mark.parametrize(("ego_x", "car_x", "again"), [(60, 210, True), (60, 139, False)])
def test_a_car_of_a_stream_is_not_taken_away_in_sight(road_map, ego_x, car_x, again):
    cars = {
        "model": [0],
        "lanes": [(0, 1, 2)],
        "s": [190.0],
        "drive": [DRIVE_FLOW],
        "travel": [100.0],
    }
    world = World(road_map, PLAIN | {"cars": cars}).at(25.0)
    world.put(CAR, car_x).at(ego_x)
    assert (world.agents.lane_s[CAR] == 190.0) == again


def meets(road_map, ego_x, ego_speed, car_x):
    """Cruise speed of a car of 10 m/s that is to be at 180 m when the ego is at 100 m."""
    cars = {
        "model": [0],
        "lanes": [(0, 1, 2)],
        "s": [110.0],
        "speed": [10.0],
        "drive": [DRIVE_MEET],
        "meet_s": [100.0],
        "meet_lane_s": [180.0],
    }
    world = World(road_map, PLAIN | {"cars": cars}).at(20.0)
    world.put(CAR, car_x).at(ego_x, ego_speed)
    assert world.agents.is_lawless[CAR]
    return float(world.agents.cruise_speed[CAR])


def test_a_car_times_itself_to_meet_the_ego(road_map):
    # The ego is 40 m away at 8 m/s: 5 s. The car has 60 m to go: 12 m/s.
    np.testing.assert_allclose(meets(road_map, 60.0, 8.0, 120.0), 12.0, rtol=1e-4)
    # 2 s for 60 m would be 30 m/s: no more than 1.5 times its speed; 40 s: no less than half.
    assert meets(road_map, 60.0, 20.0, 120.0) == 15.0
    assert meets(road_map, 60.0, 1.0, 120.0) == 5.0
    assert meets(road_map, 60.0, 0.0, 120.0) == 5.0
    # With less than 2 s to go it holds its speed: what it was given at its start, 10 m/s times 90 m
    # (70 m to go in 80 / 10 = 8 s: 8.75 m/s).
    np.testing.assert_allclose(meets(road_map, 60.0, 8.0, 161.0), 8.75, rtol=1e-4)
    # The way goes on over lanes: 200 m is beyond the meeting.
    np.testing.assert_allclose(meets(road_map, 60.0, 8.0, 205.0), 8.75, rtol=1e-4)


def test_the_car_ahead_brakes_once_there_is_one(road_map):
    world = World(road_map, PLAIN | {"brake_s": 0.45, "end_s": 190.0}).at(25.0)
    world.put(0, 101.0).put(1, 50.0).put(2, 140.0)  # 41 m ahead, behind, farther ahead
    world.at(60.0, steps=2)
    assert not world.agents.is_braking_hard.any() and world.slots.braker.tolist() == [-1, -1]
    world.at(62.0)
    assert world.agents.is_braking_hard.nonzero()[0].tolist() == [0]
    # It is that car for 0.45 s: five steps of 0.1 s, whoever comes between.
    world.put(1, 80.0).at(62.0, steps=4)
    assert world.agents.is_braking_hard.nonzero()[0].tolist() == [0]
    world.at(62.0)
    assert not world.agents.is_braking_hard.any()
    world.at(62.0, steps=3)
    assert not world.agents.is_braking_hard.any()


def test_the_car_ahead_may_be_on_the_next_lane(road_map):
    world = World(road_map, PLAIN | {"brake_s": 9.0, "end_s": 250.0}).at(25.0)
    world.put(0, 205.0).at(170.0)  # 30 m to the lane's end and 5 m beyond
    assert world.agents.is_braking_hard.nonzero()[0].tolist() == [0]
    far = World(road_map, PLAIN | {"brake_s": 9.0, "end_s": 250.0}).at(25.0)
    assert not far.put(0, 305.0).at(190.0).agents.is_braking_hard.any()


# Disturbed control


ICE = PLAIN | {
    "patches": [(70.0, 74.0), (80.0, 84.0), (0.0, 0.0)],
    "steer_noise": 0.1,
    "throttle_noise": 0.03,
}


@jax.jit
def _disturb(action, slots, scenarios, x):
    return engine.disturb(action, slots, scenarios, jnp.int32(0), x)


def disturbance(world, x):
    action = np.float32([0.5, -0.5])
    return np.asarray(_disturb(action, world.slots, world.scenarios, np.float32(x))) - action


def test_control_is_disturbed_on_the_patches_only(road_map):
    world = World(road_map, ICE).at(25.0)
    assert not disturbance(world, 71.0).any()  # before the trigger
    world.at(60.0)
    for x in (65.0, 69.9, 74.1, 79.9, 84.1, 0.0):
        assert not disturbance(world, x).any()
    first, again, second = (disturbance(world, x) for x in (70.1, 73.9, 81.0))
    np.testing.assert_array_equal(first, again)
    assert first.all() and second.all() and (first != second).all()
    world.at(71.0, steps=5)
    np.testing.assert_array_equal(disturbance(world, 72.0), first)
    world.at(151.0)
    assert not disturbance(world, 72.0).any()


def test_disturbances_are_uniform(road_map):
    found = []
    for seed in range(40):
        world = World(road_map, ICE)
        world.key = jax.random.key(seed)
        world.at(25.0).at(60.0)
        found += [disturbance(world, 71.0), disturbance(world, 81.0)]
    size = np.array(found) / [0.1, 0.03]
    assert (np.abs(size) <= 1.0).all() and (np.abs(size).max(axis=0) > 0.9).all()
    # of 80 draws of a uniform distribution: mean 0 +- 0.065, mean size 0.5 +- 0.032
    assert (np.abs(size.mean(axis=0)) < 0.2).all()
    np.testing.assert_allclose(np.abs(size).mean(axis=0), 0.5, atol=0.1)
