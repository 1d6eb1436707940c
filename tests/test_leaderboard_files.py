"""Route files of both leaderboards and the trigger file: what is read, and what is refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from carljax.sim import leaderboard_files as lf
from carljax.sim.leaderboard_files import RouteFileError

V1 = """<?xml version='1.0' encoding='UTF-8'?>
<routes>
  <route id="7" town="Town01">
    <waypoint x="10.0" y="-20.0" z="0.0" yaw="90.0" pitch="360.0" roll="0.0"/>
    <waypoint x="10.5" y="30.25" z="0.0" yaw="270.0" pitch="0.0" roll="0.0"/>
    <weather id="Noon" cloudiness="0.0"/>
  </route>
</routes>"""
V2 = """<?xml version='1.0' encoding='UTF-8'?>
<routes>
  <route id="0" town="Carla/Maps/Town10HD_Opt">
    <weathers><weather route_percentage="0" cloudiness="5.0"/></weathers>
    <waypoints>
      <position x="1.0" y="2.0" z="0.0"/><position x="3.0" y="4.0" z="0.0"/>
    </waypoints>
    <scenarios>
      <scenario type="ControlLoss" name="ControlLoss_1">
        <trigger_point x="1.5" y="2.5" z="1.0" yaw="-180.0"/>
        <distance value="20"/>
      </scenario>
    </scenarios>
  </route>
  <route id="1" town="Town01">
    <waypoints>
      <position x="10.0" y="-20.0" z="0.0"/><position x="10.5" y="30.25" z="0.0"/>
    </waypoints>
  </route>
</routes>"""
EVENT = {"transform": {"x": "1.5", "y": "-2.0", "z": "0", "yaw": "90", "pitch": "0"}}
OTHER = {
    "transform": {"x": 3, "y": 4.5, "yaw": -0.0},
    "other_actors": {"front": [{}], "left": None},
}
TRIGGERS = {
    "available_scenarios": [
        {
            "Town01": [
                {"scenario_type": "Scenario3", "available_event_configurations": [EVENT]},
                {"scenario_type": "Scenario7", "available_event_configurations": [OTHER, OTHER]},
                {"scenario_type": "Scenario9", "available_event_configurations": []},
            ]
        }
    ]
}


def write(folder, text, name="file.xml"):
    path = folder / name
    path.write_text(text)
    return path


def test_version_1_with_yaw_in_the_right_handed_frame(tmp_path):
    (route,) = lf.read_routes(write(tmp_path, V1))
    assert (route.id, route.town, route.triggers) == ("7", "Town01", ())
    # y and yaw change their sign; 270 degrees clockwise are 90 counter-clockwise.
    np.testing.assert_array_equal(route.xy, [(10.0, 20.0), (10.5, -30.25)])
    np.testing.assert_allclose(route.yaw, [-math.pi / 2, math.pi / 2])


def test_version_2_with_scenarios(tmp_path):
    first, second = lf.read_routes(write(tmp_path, V2))
    assert (first.id, first.town, first.yaw) == ("0", "Town10HD", None)
    np.testing.assert_array_equal(first.xy, [(1.0, -2.0), (3.0, -4.0)])
    (trigger,) = first.triggers
    assert (trigger.type, trigger.name) == ("ControlLoss", "ControlLoss_1")
    assert trigger.parameters == ("distance",)
    np.testing.assert_array_equal(trigger.xy, (1.5, -2.5))
    assert trigger.yaw == pytest.approx(-math.pi)
    assert second.triggers == ()


def test_waypoints_without_yaw_in_version_1(tmp_path):
    text = V1.replace('yaw="90.0"', "").replace('yaw="270.0"', "")
    assert lf.read_routes(write(tmp_path, text))[0].yaw is None


def test_yaw_is_taken_from_the_twin_in_version_1(tmp_path):
    routes = lf.read_routes(write(tmp_path, V2))
    others = lf.read_routes(write(tmp_path, V1))
    stranger, twin = lf.with_yaws(routes, others)
    assert stranger.yaw is None
    np.testing.assert_array_equal(twin.yaw, others[0].yaw)
    assert lf.with_yaws(others, [])[0].yaw is others[0].yaw


ROUTE = "file.xml: route 7"
BROKEN = {
    "no routes": ("<routes/>", "file.xml: has no routes"),
    "another root": ("<OpenDRIVE/>", "file.xml: is not routes: the root element is 'OpenDRIVE'"),
    "cut off": (V1[:200], "file.xml: is not well-formed XML"),
    "empty": ("", "file.xml: is empty"),
    "no town": (V1.replace(' town="Town01"', ""), f"{ROUTE}: <route> has no attribute 'town'"),
    "no id": (V1.replace('id="7" ', ""), "file.xml: route: <route> has no attribute 'id'"),
    "twice": (
        V1.replace("</routes>", V1[V1.index("<route ") :]),
        f"{ROUTE}: is there twice",
    ),
    "word": (V1.replace('"-20.0"', '"east"'), f"{ROUTE}, waypoint 0: y 'east' is not a number"),
    "nan": (V1.replace('"10.5"', '"nan"'), f"{ROUTE}, waypoint 1: x 'nan' is not a number"),
    "one yaw": (V1.replace('yaw="90.0"', ""), f"{ROUTE}, waypoint 0: has no yaw"),
    "no y": (V1.replace('y="30.25"', ""), f"{ROUTE}, waypoint 1: has no y"),
    "one waypoint": (
        V1.replace('<waypoint x="10.0"', '<point x="10.0"'),
        f"{ROUTE}: has 1 waypoints; it takes 2 to make a route",
    ),
    "both versions": (
        V1.replace("<weather ", '<waypoints><position x="0" y="0"/></waypoints><weather '),
        f"{ROUTE}: has waypoints of version 1 and of version 2",
    ),
    "no trigger": (
        V2.replace("trigger_point", "point"),
        "file.xml: route 0, scenario ControlLoss_1: has no trigger_point",
    ),
    "no type": (
        V2.replace('type="ControlLoss" ', ""),
        "file.xml: route 0, scenario ControlLoss_1: <scenario> has no attribute 'type'",
    ),
    "trigger yaw": (
        V2.replace('"-180.0"', '"back"'),
        "file.xml: route 0, scenario ControlLoss_1, trigger_point: yaw 'back' is not a number",
    ),
    "entity": (
        V1.replace("<routes>", '<!DOCTYPE x [<!ENTITY a "b">]>\n<routes>', 1),
        "file.xml: declares the XML entity 'a'; routes files have none",
    ),
}


@pytest.mark.parametrize("damage", sorted(BROKEN))
def test_a_broken_route_file_is_refused_in_one_line(tmp_path, damage):
    text, message = BROKEN[damage]
    path = write(tmp_path, text)
    with pytest.raises(RouteFileError) as caught:
        lf.read_routes(path)
    assert str(caught.value).startswith(f"{tmp_path}/{message}")
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    for read in (lf.read_routes, lf.read_triggers):
        with pytest.raises(RouteFileError, match="missing: can't be read: No such file"):
            read(tmp_path / "missing")


def test_triggers_as_text_and_as_numbers(tmp_path):
    towns = lf.read_triggers(write(tmp_path, json.dumps(TRIGGERS), "t.json"))
    assert list(towns) == ["Town01"]
    first, second, third = towns["Town01"]
    assert [t.type for t in towns["Town01"]] == ["Scenario3", "Scenario7", "Scenario7"]
    assert len({t.name for t in towns["Town01"]}) == 3
    np.testing.assert_array_equal(first.xy, (1.5, 2.0))
    assert first.yaw == pytest.approx(-math.pi / 2)
    np.testing.assert_array_equal(second.xy, (3.0, -4.5))
    assert second.yaw == third.yaw == 0.0


def without(values, *path):
    """A copy of nested values that lacks one of them, or has another one there."""
    out = json.loads(json.dumps(values))
    *steps, last, new = path
    inner = out
    for step in steps:
        inner = inner[step]
    inner[last] = new
    return out


AT = ("available_scenarios", 0, "Town01")
EVENTS = (*AT, 0, "available_event_configurations")
BROKEN_TRIGGERS = {
    "no object": ([], "t.json: is not an object"),
    "no list": ({"available_scenarios": 3}, "t.json: available_scenarios is not a list"),
    "town": (without(TRIGGERS, *AT, None), "t.json: Town01 is not a list"),
    "type": (
        without(TRIGGERS, *AT, 0, "scenario_type", 3),
        "t.json: Town01: an entry has no scenario_type",
    ),
    "events": (
        without(TRIGGERS, *EVENTS, {}),
        "t.json: Town01, Scenario3: available_event_configurations is not a list",
    ),
    "event": (without(TRIGGERS, *EVENTS, 0, 1), "t.json: Town01, Scenario3, event 0: is not an"),
    "no transform": (
        without(TRIGGERS, *EVENTS, 0, "transform", None),
        "t.json: Town01, Scenario3, event 0, transform: is not an object",
    ),
    "word": (
        without(TRIGGERS, *EVENTS, 0, "transform", "x", "far"),
        "t.json: Town01, Scenario3, event 0: x 'far' is not a number",
    ),
    "truth": (
        without(TRIGGERS, *EVENTS, 0, "transform", "yaw", True),
        "t.json: Town01, Scenario3, event 0: yaw 'True' is not a number",
    ),
    "none": (
        without(TRIGGERS, *EVENTS, 0, "transform", "y", None),
        "t.json: Town01, Scenario3, event 0: has no y",
    ),
}


@pytest.mark.parametrize("damage", sorted(BROKEN_TRIGGERS))
def test_broken_triggers_are_refused_in_one_line(tmp_path, damage):
    values, message = BROKEN_TRIGGERS[damage]
    path = write(tmp_path, json.dumps(values), "t.json")
    with pytest.raises(RouteFileError) as caught:
        lf.read_triggers(path)
    assert str(caught.value).startswith(f"{tmp_path}/{message}")


def test_what_is_not_json_is_named_with_its_line(tmp_path):
    path = write(tmp_path, '{\n"a": oops}', "t.json")
    with pytest.raises(RouteFileError, match=r"t\.json:2: not JSON: "):
        lf.read_triggers(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RouteFileError, match=r"t\.json: not JSON: "):
        lf.read_triggers(path)


def test_every_real_file_is_read(shared_data):
    folder = shared_data / "routes"
    v1 = lf.read_routes(folder / "longest6_v1_Town01_02_06.xml")
    v2 = lf.read_routes(folder / "longest6_v2_Town01_02_06.xml")
    assert [route.id for route in v1] == [route.id for route in v2]
    assert len(v2) == 18
    # README of the files: 46 + 54 + 62 triggers.
    assert sum(len(route.triggers) for route in v2) == 162
    for one, other in zip(lf.with_yaws(v2, v1), v1, strict=True):
        np.testing.assert_array_equal(one.yaw, other.yaw)
    for name, num in (("public_Town01_02_06", 999), ("training_Town01_02_06_07", 1110)):
        text = (folder / f"triggers_lb1_{name}.json").read_text()
        towns = lf.read_triggers(folder / f"triggers_lb1_{name}.json")
        assert sum(map(len, towns.values())) == text.count('"transform"') == num
