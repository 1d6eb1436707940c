"""The bundled towns against values worked out by hand from their plans in tools/towns."""

from __future__ import annotations

import collections
import functools
import importlib.util
import math
import pathlib
import subprocess
import sys

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from carljax.sim import opendrive, towns
from carljax.sim.road_network import Lane, RoadNetwork

TOWNS = ("grid", "highway", "suburb", "village")
MAKE_TOWNS = pathlib.Path(__file__).resolve().parent.parent / "tools" / "make_towns.py"
KMH = 1 / 3.6


@functools.cache
def network(name: str) -> RoadNetwork:
    return opendrive.load(towns.path(name))


def driving(name: str) -> list[Lane]:
    return [lane for lane in network(name).lanes if lane.kind == "driving"]


def length(lane: Lane) -> float:
    return float(np.linalg.norm(np.diff(lane.xyz[:, :2], axis=0), axis=1).sum())


def lane_between(name: str, start: tuple[float, float], end: tuple[float, float]) -> Lane:
    """The one driving lane that leads from `start` to `end`, to the millimetre."""
    found = [
        lane
        for lane in driving(name)
        if math.dist(lane.xyz[0, :2], start) < 1e-3 and math.dist(lane.xyz[-1, :2], end) < 1e-3
    ]
    assert len(found) == 1, f"{len(found)} lanes lead from {start} to {end}"
    return found[0]


def wrapped(angle: np.ndarray | float) -> np.ndarray:
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def test_names_and_paths_of_the_bundled_towns() -> None:
    assert towns.names() == TOWNS
    assert all(towns.path(name).is_file() for name in TOWNS)
    assert all(towns.path(name).stat().st_size < 400_000 for name in TOWNS)


def test_each_town_is_either_for_training_or_kept_for_scoring() -> None:
    assert sorted(towns.TRAINING + towns.HELD_OUT) == list(towns.names())


def test_an_unknown_town_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(ValueError, match="'gird'; there are: grid, highway, suburb, village"):
        towns.path("gird")


@pytest.mark.skipif(
    importlib.util.find_spec("scenariogeneration") is None or not MAKE_TOWNS.exists(),
    reason="needs scenariogeneration and the repository's tools/ to draw the towns again",
)
def test_the_towns_are_drawn_again_byte_for_byte(tmp_path: pathlib.Path) -> None:
    command = [sys.executable, str(MAKE_TOWNS), str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    for name in TOWNS:
        assert (tmp_path / f"{name}.xodr").read_bytes() == towns.path(name).read_bytes(), name


# name: driving lanes outside and inside junctions, junctions, lights, stop, yield and speed signs,
# crosswalks, stop lines.
#
# grid. 5 x 4 crossings less 4 corners: 16 junctions, 6 of them with 4 arms and 10 with 3, so
# 6 * 4 + 10 * 3 = 54 lights and stop lines. 31 streets, of which 8 join in 4 around the corners: 27
# roads, 7 of them avenues: 7 * 4 + 20 * 2 = 68 lanes, 27 * 2 = 54 speed signs. Inside: 16 where the
# avenues cross, 14 at the 3 crossings of an avenue with a street, 12 at the other 2, 6 at each of
# the 10 with three arms: 16 + 42 + 24 + 60 = 142. Crosswalks: 4 at each of 6, 2 at the 6 of the
# northern and southern rim, 1 at the 4 of the others: 24 + 12 + 4 = 40.
#
# village. 11 two-way roads, one of 3 sections, make 2 * 13 = 26 lanes, and the ring 4 more; inside
# 3 crossings with 12 lanes, 2 with 6, 4 at the ring with 3: 36 + 12 + 12 = 60. Stop signs: 4 + 1
# + 2; yield signs: 4 at the ring, 2 + 1; 11 * 2 + 4 speed signs; a crosswalk at every stop sign; a
# stop line at every sign but those of the ring: 7 + 3.
#
# highway. 5 roads with 4 lanes, 1 with 6, 6 two-way local roads, 4 ramps: 20 + 6 + 12 + 4 = 42
# lanes. Inside: 2 crossings with 14, 2 ramp zones with 8 (each way 2 on, 1 aside, 1 ramp), 4 ramp
# ends with 4: 28 + 16 + 16 = 60. Lights: 4 + 4 at the crossings, 3 + 2 at the inner ramp ends; stop
# lines the same and 1 at the stop sign; 12 * 2 + 4 speed signs; crosswalks 2 + 2 + 1 + 1.
#
# suburb. 3 roads of the avenue with 4 lanes, 4 with bays in 3 sections of 2, 12 plain ones with 2,
# the ring's 4: 12 + 24 + 24 + 4 = 64. Inside: 2 crossings of the avenue's ends with 12, 2 junctions
# on it with 8 (4 along, 4 turns), 4 at the ring with 3, 4 with three arms of 6, 2 with 12: 24 + 16
# + 12 + 24 + 24 = 100. 14 arms with lights; stop signs 1 + 2 + 4; yield signs 4 at the ring and 3;
# 19 * 2 + 4 speed signs; a crosswalk at every light and stop sign; a stop line at each of these
# and at the 3 yield signs away from the ring.
COUNTS = {
    "grid": (68, 142, 16, 54, 0, 0, 54, 40, 54),
    "suburb": (64, 100, 14, 14, 7, 7, 42, 21, 24),
    "village": (30, 60, 9, 0, 7, 7, 26, 7, 10),
    "highway": (42, 60, 8, 13, 1, 0, 28, 6, 14),
}


@pytest.mark.parametrize("name", TOWNS)
def test_counts_are_those_of_the_plan(name: str) -> None:
    town = network(name)
    inside = sum(lane.junction is not None for lane in driving(name))
    kinds = collections.Counter(signal.kind for signal in town.signals)
    assert COUNTS[name] == (
        len(driving(name)) - inside,
        inside,
        len(town.junctions),
        kinds["light"],
        kinds["stop"],
        kinds["yield"],
        kinds["speed"],
        len(town.crosswalks),
        len(town.stop_lines),
    )
    assert kinds["other"] == 0 and town.warnings == () and not town.left_hand_traffic


# CARLA's reader, sampled every metre, sums up to 8.51, 10.01 and 5.49 km; it misses half a metre at
# the ends of each of 210, 102 and 90 lanes. The suburb's is that of the plan's reference lines.
@pytest.mark.parametrize(
    ("name", "km"), [("grid", 8.61), ("highway", 10.06), ("suburb", 8.98), ("village", 5.53)]
)
def test_lane_kilometres(name: str, km: float) -> None:
    assert sum(length(lane) for lane in driving(name)) / 1000 == pytest.approx(km, abs=0.03)


@pytest.mark.parametrize("name", TOWNS)
def test_every_lane_goes_on_and_every_lane_can_be_reached(name: str) -> None:
    lanes = network(name).lanes
    index = {i: k for k, i in enumerate(i for i, ln in enumerate(lanes) if ln.kind == "driving")}
    assert all(lanes[i].successors and lanes[i].predecessors for i in index)
    edges = np.array([(index[i], index[j]) for i in index for j in lanes[i].successors])
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(index), len(index)))
    components, _ = connected_components(graph, connection="strong")
    assert components == 1


@pytest.mark.parametrize("name", TOWNS)
def test_lanes_meet_their_successors_without_gap_or_kink(name: str) -> None:
    lanes = network(name).lanes
    for lane in driving(name):
        for k in lane.successors:
            where = f"road {lane.road_id} lane {lane.lane_id} to road {lanes[k].road_id}"
            assert np.linalg.norm(lanes[k].xyz[0] - lane.xyz[-1]) < 1e-3, where
            assert abs(wrapped(lanes[k].yaw[0] - lane.yaw[-1])) < 1e-2, where
            assert abs(lanes[k].width[0] - lane.width[-1]) < 1e-3, where


@pytest.mark.parametrize("name", TOWNS)
def test_no_bend_is_tighter_than_eight_metres(name: str) -> None:
    for lane in driving(name):
        step = np.linalg.norm(np.diff(lane.xyz[:, :2], axis=0), axis=1)
        turned = np.abs(wrapped(np.diff(lane.yaw)))
        assert np.all(turned <= step / 8.0 + 1e-9), f"road {lane.road_id} lane {lane.lane_id}"


# Lanes are 3.5 m wide but for the roundabout's ring (4.5 m) and the street that narrows (2.9 m).
@pytest.mark.parametrize(
    ("name", "narrowest", "widest"),
    [("grid", 3.5, 3.5), ("highway", 3.5, 3.5), ("suburb", 3.5, 4.5), ("village", 2.9, 4.5)],
)
def test_widths(name: str, narrowest: float, widest: float) -> None:
    widths = np.concatenate([lane.width for lane in driving(name)])
    assert widths.min() == pytest.approx(narrowest, abs=1e-4)
    assert widths.max() == pytest.approx(widest, abs=1e-4)
    assert np.median(widths) == pytest.approx(3.5, abs=1e-9)


@pytest.mark.parametrize("name", TOWNS)
def test_every_lane_has_a_speed_limit_and_its_signs_say_the_same(name: str) -> None:
    town = network(name)
    limits = {"highway": {40, 50, 60, 80, 100}, "suburb": {30, 50, 60}}.get(name, {30, 50})
    assert {round((lane.speed_limit or 0) / KMH, 6) for lane in driving(name)} == limits
    for signal in town.signals:
        if signal.kind == "speed":
            assert signal.governed, signal.id
            for place in signal.governed:
                assert town.lanes[place.lane].speed_limit == pytest.approx(signal.value)


@pytest.mark.parametrize("name", ["grid", "highway", "suburb"])
def test_a_light_governs_every_lane_of_its_junction_exactly_once(name: str) -> None:
    town = network(name)
    lights = {signal.id: signal for signal in town.signals if signal.kind == "light"}
    governed = collections.Counter(p.lane for light in lights.values() for p in light.governed)
    assert all(light.governed for light in lights.values())
    assert all(p.distance < 0.01 for light in lights.values() for p in light.governed)
    signalised = [junction for junction in town.junctions.values() if junction.controllers]
    expected = {lane for junction in signalised for lane in junction.lanes}
    assert set(governed) == expected and set(governed.values()) == {1}
    switched = [i for c in town.controllers.values() for i in c.signals]
    assert sorted(switched) == sorted(lights)
    served = [c for junction in signalised for c in junction.controllers]
    assert sorted(served) == sorted(town.controllers)


def test_grid_serves_opposing_arms_together_at_all_crossings_but_one() -> None:
    # 16 crossings with lights: two controllers each, but (2, 2) has one for each of its four arms.
    sizes = collections.Counter(len(j.controllers) for j in network("grid").junctions.values())
    assert sizes == {2: 15, 4: 1}


def test_grid_street_and_its_right_turn_lie_where_the_plan_puts_them() -> None:
    # Crossings at x = 100 and 210, y = 0. A street leaves 1.75 + 8.5 = 10.25 m from a street's
    # middle and 5.25 + 8.5 = 13.75 m from an avenue's; lane centres lie 1.75 m off the middle.
    lane = lane_between("grid", (110.25, -1.75), (196.25, -1.75))
    assert np.allclose(lane.xyz[:, 1], -1.75, atol=1e-6) and np.allclose(lane.yaw, 0, atol=1e-9)
    assert lane.speed_limit == pytest.approx(30 * KMH)
    # Coming from the east, right into the street to the north: a quarter circle of 8.5 m around
    # (110.25, 10.25), 8.5 * pi / 2 = 13.352 m long.
    turn = lane_between("grid", (110.25, 1.75), (101.75, 10.25))
    assert np.allclose(np.hypot(*(turn.xyz[:, :2] - (110.25, 10.25)).T), 8.5, atol=1e-5)
    assert length(turn) == pytest.approx(13.352, abs=5e-3)


def test_grid_avenues_are_as_long_as_the_plan_says() -> None:
    # From north to south 76.25 - 10.25, 179.75 - 103.75 and 269.75 - 200.25: 211.5 m. From west to
    # east 89.75 - 10.25, 196.25 - 110.25, 299.75 - 223.75 and 399.75 - 320.25: 321 m. 4 lanes each.
    fast = [
        ln for ln in driving("grid") if ln.junction is None and (ln.speed_limit or 0) > 40 * KMH
    ]
    assert sum(length(lane) for lane in fast) == pytest.approx(4 * (211.5 + 321), abs=0.01)


def test_village_ring_is_a_circle_of_fifteen_metres() -> None:
    ring = [ln for ln in driving("village") if ln.junction is None and ln.width.min() > 4.4]
    # Between the arms, which take 30 degrees to either side, 30 degrees are left: 15 * pi / 6 m.
    assert len(ring) == 4
    for lane in ring:
        assert np.allclose(np.hypot(*lane.xyz[:, :2].T), 15.0, atol=1e-5)
        assert length(lane) == pytest.approx(7.854, abs=5e-3)
        # Counter-clockwise: the direction of travel is a quarter turn ahead of the radius.
        radius = np.arctan2(lane.xyz[:, 1], lane.xyz[:, 0])
        assert np.allclose(wrapped(lane.yaw - radius - np.pi / 2), 0, atol=1e-5)


def test_village_hills() -> None:
    heights = np.concatenate([lane.xyz[:, 2] for lane in driving("village")])
    # The lowest crossing lies at -1 m, the highest hill 5 m above the mean of crossings at 2, 4 m.
    assert heights.min() == pytest.approx(-1.0, abs=1e-6)
    assert heights.max() == pytest.approx(8.0, abs=2e-3)
    for lane in driving("village"):
        step = np.linalg.norm(np.diff(lane.xyz[:, :2], axis=0), axis=1)
        assert np.all(np.abs(np.diff(lane.xyz[:, 2])) < 0.08 * step)


def test_village_gives_way_at_the_ring_and_stops_at_the_eastern_crossing() -> None:
    town = network("village")
    ring = [s for s in town.signals if s.kind == "yield" and np.hypot(*s.xyz[:2]) < 30]
    assert len(ring) == 4 and all(len(signal.governed) == 1 for signal in ring)
    east = [s for s in town.signals if s.kind == "stop" and math.dist(s.xyz[:2], (150, 20)) < 20]
    # Each of the four stops governs the left turn, the way on and the right turn.
    assert len(east) == 4 and all(len(signal.governed) == 3 for signal in east)


def test_suburb_serves_the_avenue_first_and_then_each_side_street() -> None:
    town = network("suburb")
    sizes = [
        [len(town.controllers[c].signals) for c in junction.controllers]
        for junction in town.junctions.values()
        if junction.controllers
    ]
    # Two crossings with a street on either side, two junctions with a street on one.
    assert sorted(sizes) == [[2, 1], [2, 1], [2, 1, 1], [2, 1, 1]]


def test_suburb_has_bays_beside_four_streets_and_none_near_junctions() -> None:
    bays = [lane for lane in network("suburb").lanes if lane.kind == "parking"]
    assert len(bays) == 8
    for lane in bays:
        assert lane.width.max() == pytest.approx(2.2, abs=1e-6)
        assert lane.width[[0, -1]] == pytest.approx([0, 0], abs=1e-4)


def test_suburb_is_kept_for_scoring() -> None:
    assert towns.HELD_OUT == ("suburb",) and "suburb" not in towns.TRAINING


def test_highway_lanes_lie_where_the_plan_puts_them() -> None:
    # North straight: y = 125, from x = 250 - 80 - 40 = 130 to -130. Lane centres are 1.5 + 1.75 and
    # 1.5 + 5.25 m off the middle; the outer carriageway runs westwards there, on the northern side.
    for aside in (3.25, 6.75):
        outer = lane_between("highway", (130, 125 + aside), (-130, 125 + aside))
        inner = lane_between("highway", (-130, 125 - aside), (130, 125 - aside))
        for lane in (outer, inner):
            assert lane.speed_limit == pytest.approx(100 * KMH)
            assert length(lane) == pytest.approx(260, abs=1e-3)
    # South: the third lane, 1.5 + 8.75 m off the middle at y = -125, from -50 to 50.
    third = lane_between("highway", (-50, -135.25), (50, -135.25))
    assert third.speed_limit == pytest.approx(80 * KMH)
    # It begins where a lane from the highway and the ramp meet, and ends where they part.
    assert len(third.predecessors) == len(third.successors) == 2
    lane_between("highway", (50, -114.75), (-50, -114.75))


def test_highway_inner_and_outer_carriageway_neighbour_each_other_rightly() -> None:
    lanes = network("highway").lanes
    middle = lane_between("highway", (-50, -131.75), (50, -131.75))
    left, right = lanes[middle.left], lanes[middle.right]
    # Travelling east on the south side, the fast lane is to the north, the third lane to the south.
    assert left.xyz[0, 1] == pytest.approx(-128.25, abs=1e-3) and middle.left_is_same_direction
    assert right.xyz[0, 1] == pytest.approx(-135.25, abs=1e-3) and middle.right_is_same_direction
