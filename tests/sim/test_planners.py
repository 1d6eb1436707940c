"""Planners in scenes on hand-made towns: what a careful driver does, and what IDM does not."""

import numpy as np
import pytest
import shapely
from planner_stage import DT, Other, Scene, drive_alone, play

from carljax.planners import PLANNERS
from carljax.sim.types import KIND_PEDESTRIAN, LIGHT_RED

BOTH = pytest.mark.parametrize("planner", sorted(PLANNERS))
FRONT = 4.892 / 2  # m from the ego's centre to its bumper
END = 80 + 20 + 80  # last point of a route straight on


def last_speed(path):
    return float(path["speed"][-1])


def oncoming(speed, starts):
    """Cars from the eastern end, straight on, each at its time: they mind nobody."""
    return tuple(Other((88.0, 1.75), np.pi, speed, t, way=("east", "straight")) for t in starts)


def walker(x, starts, speed=1.5):
    """Crosses the western arm from the south, from 4.25 m beside the middle of the ego's lane."""
    size = (0.5, 0.5)
    return Other((x, -6.0), np.pi / 2, speed, starts, size=size, kind=KIND_PEDESTRIAN)


@BOTH
@pytest.mark.parametrize("turn", ["straight", "left", "right"])
def test_an_empty_crossing_is_passed(world, planner, turn):
    path = play(world, planner, Scene("plain", turn=turn))
    assert path["route_idx"][-1] >= 170 and not path["touches"].any()
    # 10 m/s allowed; PDM-Lite drives at 0.72 of that
    fastest = {"idm": 10.0, "pdm-lite": 7.2}[planner]
    assert path["speed"].max() == pytest.approx(fastest, abs=0.85)


@pytest.mark.parametrize(("planner", "least", "most"), [("idm", 0.9, 2.0), ("pdm-lite", 3.5, 5.0)])
def test_it_stops_behind_a_car_that_stands(world, planner, least, most):
    stands = Other((-30.0, -1.75), 0.0, 0.0, way=("west", "straight"))
    path = play(world, planner, Scene("plain", others=(stands,)))
    assert not path["touches"].any() and last_speed(path) < 0.05
    gap = -30.0 - 2.0 - (path["xy"][-1, 0] + FRONT)
    assert least < gap < most


@BOTH
def test_it_follows_a_slow_car(world, planner):
    slow = Other((-70.0, -1.75), 0.0, 4.0, way=("west", "straight"))
    path = play(world, planner, Scene("plain", others=(slow,)))
    assert not path["touches"].any()
    np.testing.assert_allclose(path["speed"][200:300], 4.0, atol=0.1)


@BOTH
def test_it_waits_for_green(world, planner):
    start, _ = world.light("west")
    # Red from 13 to 30 s. It starts 15 s in and would be at the line, 77 m on, after 8 or 11 s.
    path = play(world, planner, Scene("lights", clock=start + 15.0))
    assert (path["light"][:145] == LIGHT_RED).all() and not path["light"][155:240].any()
    front = path["xy"][:145, 0] + FRONT
    assert (front < -10.0).all() and front[-1] > -13.0 and path["speed"][144] < 0.5
    assert path["route_idx"][240] > 100


@BOTH
def test_it_halts_at_a_stop_sign_and_goes_on(world, planner):
    path = play(world, planner, Scene("signs", arm="north"))
    line = np.argmax(path["crossed"])
    assert path["crossed"].any() and path["met"].any() and np.argmax(path["met"]) < line
    assert path["speed"][line:].max() > 5.0 and path["route_idx"][-1] > 150


def test_pdm_lite_brakes_for_a_pedestrian_before_it_is_on_the_lane(world):
    # 7.2 m/s: at -42 after 6.5 s. On the lane, y > -3.5, from 3.8 + 2.5 / 1.5 = 5.5 s on.
    path = play(world, "pdm-lite", Scene("plain", speed=7.2, others=(walker(-40.0, 3.8),)))
    assert not path["touches"].any()
    assert path["speed"][:55].min() < 6.5
    assert path["route_idx"][-1] >= END - 10


def test_idm_does_not_see_a_pedestrian_beside_its_lane(world):
    # 10 m/s: at -42 after 4.6 s, when the pedestrian has come 2.6 m far, to y = -3.4.
    path = play(world, "idm", Scene("plain", speed=10.0, others=(walker(-40.0, 2.9),)))
    assert path["speed"][:38].min() > 9.0
    assert path["touches"].any()


def test_pdm_lite_gives_way_to_oncoming_traffic_in_a_left_turn(world):
    # Both would be in the middle about 12 s after the start.
    path = play(world, "pdm-lite", Scene("plain", turn="left", others=oncoming(8.0, (1.0,))))
    assert not path["touches"].any()
    assert path["route_idx"][-1] > 150
    # It has not waited for longer than the car needs: it is past the middle 4 s later.
    assert path["route_idx"][170] > 90


def test_pdm_lite_waits_for_a_gap_in_a_stream(world):
    # 20 m apart from centre to centre: 2.5 s, too short to turn in; the last passes after 18.4 s.
    stream = oncoming(8.0, (0.0, 2.5, 5.0, 7.5))
    path = play(world, "pdm-lite", Scene("plain", turn="left", others=stream))
    assert not path["touches"].any()
    assert path["route_idx"][170] < 90
    assert path["route_idx"][-1] > 150


def test_pdm_lite_is_comfortable_on_an_empty_road(world):
    path = play(world, "pdm-lite", Scene("plain", turn="left", speed=0.0))
    jerk = np.diff(path["accel"]) / DT
    assert np.abs(jerk).max() < 30.0  # source: paper, table of comfort thresholds


@BOTH
@pytest.mark.parametrize("seed", [0, 1])
def test_a_winding_route_is_driven_to_its_end_along_the_middle_of_its_lanes(bundled, planner, seed):
    route, path = drive_alone(bundled["village"], planner, 300.0, seed, 800)
    num = int(route.num_points)
    assert path["route_idx"][-1] == num - 1
    line = shapely.LineString(route.xy[:num])
    on_route = path["route_idx"] < num - 1
    away = shapely.distance(shapely.points(path["xy"][on_route].astype(float)), line)
    assert away.max() < 0.5
