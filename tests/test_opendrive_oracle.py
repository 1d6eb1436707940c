"""The OpenDRIVE importer against CARLA's own reading of the same files.

The stored readings and the tool that compares are private data, looked for in ../shared; the tests
that need them skip without. With carla installed it reads the small files of `opendrive_files` on
the spot.
"""

import importlib.util
import json
import pathlib
import subprocess
import sys

import numpy as np
import opendrive_files as of
import pytest

from carljax import maps
from carljax.sim import opendrive

SHARED = pathlib.Path(__file__).resolve().parents[2] / "shared"
DATA = SHARED / "data"
TOOL = SHARED / "tools" / "carla_map_oracle.py"
needs_data = pytest.mark.skipif(
    not (TOOL.exists() and (DATA / "oracle").exists()),
    reason="CARLA's towns and its reading of them are not in ../shared",
)
needs_carla = pytest.mark.skipif(
    importlib.util.find_spec("carla") is None or not TOOL.exists(),
    reason="needs the carla package and ../shared/tools/carla_map_oracle.py",
)
TOWNS = ("Town01", "Town02", "Town07")
# Files where CARLA departs from the standard and we don't follow it; each has a test below.
DEPARTURES = {"Ex_Lane-Border", "UC_Simple-X-Junction-TrafficLights", "sample1.1"}


def edge_names():
    return sorted(p.stem for p in (DATA / "oracle" / "edge").glob("*.npz"))


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("carla_map_oracle", TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def as_carla(network):
    """What `maps lanes` writes, in CARLA's left-handed frame."""
    arrays = maps.lane_arrays(network)
    for name in ("lane_xy", "crosswalk_xy"):
        arrays[name] = arrays[name] * (1.0, -1.0)
    return arrays


def check(report, links=True):
    centre = report["centre_all"]
    assert centre["mean"] < 0.02
    assert centre["within_0.10m"] >= 0.999
    assert centre["within_0.50m"] == 1.0
    assert report["lanes_missing_mean_over_1m"] == 0
    assert report["invented_over_2m"] == 0
    assert report["width_error"]["p99"] < 0.01
    if links:
        assert (report["succ"]["missing"], report["succ"]["extra"]) == (0, 0)
    assert report["crosswalks"]["imported"] == report["crosswalks"]["oracle"]
    assert (report["signals"]["missing"], report["signals"]["extra"]) == (0, 0)


@needs_data
@pytest.mark.parametrize("name", [*TOWNS, *(f"edge/{n}" for n in edge_names())])
def test_lanes_links_and_signals_are_carlas(tool, name):
    stem = name.rpartition("/")[2]
    if stem == "Ex_Lane-Border":
        pytest.skip("CARLA does not read <border>: its lanes have no width; tested on its own")
    network = opendrive.load(DATA / "maps" / f"{name}.xodr")
    oracle = dict(np.load(DATA / "oracle" / f"{name}.npz"))
    report = tool.compare(as_carla(network), oracle)
    check(report, links=stem not in DEPARTURES)
    json.dumps(report)


@needs_data
@pytest.mark.parametrize("name", ["UC_Simple-X-Junction-TrafficLights", "sample1.1"])
def test_links_differ_only_where_carla_takes_a_junction_for_a_road(tool, name):
    """CARLA forgets elementType: a junction with the id of a road is that road to it.

    Ids are unique among roads and among junctions, not across (OpenDRIVE 1.8, 6.4). We follow the
    link to the junction; CARLA finds a dead end, or whatever lane of that road has the right sign.
    """
    network = opendrive.load(DATA / "maps" / "edge" / f"{name}.xodr")
    oracle = dict(np.load(DATA / "oracle" / "edge" / f"{name}.npz"))
    roads = {lane.road_id for lane in network.lanes}
    clash = roads & set(network.junctions)
    assert clash
    key = [(int(x.road_id), x.section, x.lane_id) for x in network.lanes]
    driving = {k for k, x in zip(key, network.lanes, strict=True) if x.kind == "driving"}
    mine = {(*key[i], *key[j]) for i, x in enumerate(network.lanes) for j in x.successors}
    theirs = {tuple(map(int, r)) for r in oracle["succ"]}
    for row in mine - theirs:  # all lead into a junction with such an id
        target = network.lanes[key.index(row[3:])]
        assert target.junction in clash
    # What CARLA has alone leads to lanes that nobody drives on.
    assert all(row[3:] not in driving for row in theirs - mine)
    assert len(mine & theirs) > 10


@needs_data
def test_borders_are_the_outer_edges_of_lanes():
    network = opendrive.load(DATA / "maps" / "edge" / "Ex_Lane-Border.xodr")
    lanes = {(x.section, x.lane_id): x for x in network.lanes}
    np.testing.assert_allclose(lanes[0, -1].width, 3.57)
    np.testing.assert_allclose(lanes[0, -1].xyz[:, 1], -1.785)
    # Section 1: the border of lane -2 goes from -3.57 to -7.14 over 20 m.
    grown = lanes[1, -2]
    far = grown.s > 70.0
    np.testing.assert_allclose(grown.width[far], 3.57)
    np.testing.assert_allclose(grown.xyz[far, 1], -5.355)


@needs_data
@pytest.mark.parametrize("name", TOWNS)
def test_height_heading_and_neighbours_are_carlas(name):
    network = opendrive.load(DATA / "maps" / f"{name}.xodr")
    oracle = np.load(DATA / "oracle" / f"{name}.npz")
    lanes = {(int(x.road_id), x.section, x.lane_id): x for x in network.lanes}
    along, height, turn = [], [], []
    rows = zip(oracle["wp_ids"], oracle["wp_xyz"], oracle["wp_yaw"], oracle["wp_s"], strict=True)
    for ids, xyz, yaw, s in rows:
        lane = lanes[tuple(ids[:3].tolist())]
        order = np.argsort(lane.s)
        place = [np.interp(s, lane.s[order], lane.xyz[order, i]) for i in range(3)]
        along.append(np.hypot(place[0] - xyz[0], place[1] + xyz[1]))
        height.append(abs(place[2] - xyz[2]))
        heading = np.interp(s, lane.s[order], np.unwrap(lane.yaw)[order])
        turn.append(abs((heading + np.deg2rad(float(yaw)) + np.pi) % (2 * np.pi) - np.pi))
        assert (lane.junction is not None) == (ids[3] != -1)
    assert max(along) < 0.02
    assert max(height) < 0.01
    assert max(turn) < 0.02
    mine = set()
    for key, lane in lanes.items():
        sides = (lane.left, lane.left_is_same_direction), (lane.right, lane.right_is_same_direction)
        for side, (other, same) in enumerate(sides):
            if other >= 0:
                x = network.lanes[other]
                mine.add((*key, side, int(x.road_id), x.section, x.lane_id, int(same)))
    assert mine == {tuple(r) for r in oracle["neighbour"].tolist()}


@needs_data
@pytest.mark.parametrize("name", TOWNS)
def test_signals_rule_the_lanes_that_carla_says(name):
    network = opendrive.load(DATA / "maps" / f"{name}.xodr")
    oracle = np.load(DATA / "oracle" / f"{name}.npz")
    driving = {(int(x.road_id), x.lane_id) for x in network.lanes if x.kind == "driving"}
    ruled = {}
    for row, low, high in oracle["lm_validity"].tolist():
        road = int(oracle["lm_num"][row][4])
        lanes = {(road, i) for i in range(min(low, high), max(low, high) + 1)} & driving
        ruled.setdefault(str(oracle["lm_id"][row]), set()).update(lanes)
    values = dict(zip(oracle["lm_id"].tolist(), oracle["lm_num"][:, 7], strict=True))
    codes = dict(zip(oracle["lm_id"].tolist(), oracle["lm_type"].tolist(), strict=True))
    place = dict(zip(oracle["lm_id"].tolist(), oracle["lm_num"][:, :2], strict=True))
    for signal in network.signals:
        lanes = [network.lanes[g.lane] for g in signal.governed]
        assert {(int(x.road_id), x.lane_id) for x in lanes} == ruled.get(signal.id, set())
        assert signal.type == codes[signal.id]
        # CARLA moves posts that stand on a lane by 0.25 m.
        assert np.hypot(*(signal.xyz[:2] - place[signal.id] * (1, -1))) < 0.3
        if signal.kind == "speed":
            assert signal.value * 3.6 == pytest.approx(values[signal.id])


@needs_data
def test_crosswalks_lie_where_carla_has_them():
    network = opendrive.load(DATA / "maps" / "Town07.xodr")
    oracle = np.load(DATA / "oracle" / "Town07.npz")
    ptr = oracle["crosswalk_ptr"]
    theirs = [oracle["crosswalk_xyz"][a:b] * (1, -1, 1) for a, b in zip(ptr, ptr[1:], strict=False)]
    assert len(theirs) == len(network.crosswalks)
    for mine in network.crosswalks:
        other = min(theirs, key=lambda x: float(np.hypot(*(x.mean(0) - mine.mean(0))[:2])))
        assert mine.shape == other.shape
        # CARLA turns the lateral offset with the object's heading: up to some centimetres off.
        np.testing.assert_allclose(mine, other, atol=0.1)


@needs_data
@pytest.mark.parametrize("name", ["Town06", "Issue274", "zero_width"])
def test_other_files_load_too(name):
    path = next((DATA / "maps").glob(f"**/{name}.xodr"))
    assert len(opendrive.load(path).lanes) > 3


@needs_carla
@pytest.mark.parametrize("name", sorted(of.FILES))
def test_odd_small_files_are_read_as_carla_reads_them(tool, tmp_path, name):
    path, out = tmp_path / f"{name}.xodr", tmp_path / "oracle.npz"
    path.write_text(of.FILES[name], encoding="utf-8")
    # carla.Map ends the process on some files: not ours, please.
    done = subprocess.run(
        [sys.executable, str(TOOL), "dump", str(path), str(out)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-500:]
    check(tool.compare(as_carla(opendrive.load(path)), dict(np.load(out))))
