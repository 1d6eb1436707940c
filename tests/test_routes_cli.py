"""Banks of routes on disk and `python -m carljax.routes`: what is written, read and refused."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest
from PIL import Image

from carljax import build, route_bank, routes
from carljax.config import HELD_OUT_SEED, ConfigError, RunConfig, TrainConfig
from carljax.route_bank import BankError
from carljax.sim import journey as journey_module
from carljax.sim import town as town_module
from carljax.sim import towns
from carljax.sim.scenarios import registry

NUM, LENGTH, SPACING, SEED = 4, 400.0, 60.0, 3
MAKE = ["--map", "village", "--num", str(NUM), "--length", str(LENGTH), "--seed", str(SEED)]
MAKE += ["--scenario-spacing", str(SPACING)]


@pytest.fixture(scope="module")
def village():
    return town_module.load(towns.path("village"))


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    """A bank of the village that the command has made."""
    path = tmp_path_factory.mktemp("bank") / "village.npz"
    assert routes.main(["make", str(path), *MAKE]) == 0
    return path


def refused(capsys, *args):
    """The one line that a command ends with."""
    assert routes.main([str(arg) for arg in args]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ") and printed.err.count("\n") == 1
    return printed.err[7:-1]


def rewritten(path, out, **changes):
    """A bank with other arrays in it; None takes one away."""
    with np.load(path) as file:
        arrays = dict(file)
    for name, value in changes.items():
        arrays.pop(name, None)
        if value is not None:
            arrays[name] = value
    np.savez(out, **arrays)
    return out


def assert_same(one, other):
    for left, right in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert np.asarray(left).dtype == np.asarray(right).dtype
        np.testing.assert_array_equal(left, right)


def test_what_is_read_is_what_was_drawn(bank, village):
    made = route_bank.read_origin(bank)
    drawn = route_bank.make(village, made)
    read = route_bank.load(bank, village, towns.path("village"))
    assert len(drawn) == len(read) == NUM
    assert sum(len(one.scenarios) for one in read) > NUM
    for one, other in zip(drawn, read, strict=True):
        assert len(one.scenarios) == len(other.scenarios)
    assert_same(journey_module.stack_routes(drawn), journey_module.stack_routes(read))
    assert_same(journey_module.stack_scenarios(drawn), journey_module.stack_scenarios(read))


def test_routes_are_long_enough_and_lie_on_driving_lanes(bank, village):
    for one in route_bank.load(bank, village, towns.path("village")):
        assert int(one.route.num_points) == LENGTH + 1
        assert one.route.town == 0
        assert 0 <= one.route.lane.min() and one.route.lane.max() < len(village.lanes.length)
        assert village.lanes.junction[one.route.lane[0]] is None
        triggers = [float(scenario.trigger_s) for scenario in one.scenarios]
        assert all(0 < trigger < LENGTH for trigger in triggers)


def test_the_same_command_gives_the_same_bytes_and_another_seed_others(bank, tmp_path, capsys):
    again, other = tmp_path / "again.npz", tmp_path / "other.npz"
    assert routes.main(["make", str(again), *MAKE]) == 0
    assert again.read_bytes() == bank.read_bytes()
    assert routes.main(["make", str(other), *MAKE, "--seed", "4"]) == 0
    assert other.read_bytes() != bank.read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"again.npz", "other.npz"}


def test_a_bank_that_holds_just_that_is_left_as_it_is(bank, tmp_path, capsys, monkeypatch):
    path = tmp_path / "bank.npz"
    shutil.copy(bank, path)
    before = path.stat()
    with monkeypatch.context() as patch:
        patch.setattr(route_bank, "make", None)  # nothing is drawn
        assert routes.main(["make", str(path), *MAKE]) == 0
    assert capsys.readouterr().out == f"{path}: holds these routes already\n"
    assert (path.stat().st_mtime_ns, path.stat().st_ino) == (before.st_mtime_ns, before.st_ino)
    # One that was drawn otherwise, or can't be read, is drawn anew.
    for damage in (None, "text"):
        if damage:
            path.write_text(damage)
        changed = [*MAKE, "--num", "2"] if damage is None else MAKE
        assert routes.main(["make", str(path), *changed]) == 0
        assert ": 2 routes" in (out := capsys.readouterr().out) or f": {NUM} routes" in out
    assert path.read_bytes() == bank.read_bytes()


def test_no_scenarios_on_request(tmp_path, village):
    path = tmp_path / "bank.npz"
    assert routes.main(["make", str(path), *MAKE, "--scenario-spacing", "0", "--num", "1"]) == 0
    (one,) = route_bank.load(path, village, towns.path("village"))
    assert one.scenarios == ()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--num", "0"], "--num 0: is below the least allowed, 1"),
        (["--seed", "-1"], "--seed -1: is below 0"),
        (["--seed", str(HELD_OUT_SEED)], f"--seed {HELD_OUT_SEED}: is the seed of the routes for"),
        (["--length", "50"], "--length 50: must be from 200 to 20000 m"),
        (["--length", "nan"], "--length nan: must be from 200 to 20000 m"),
        (["--scenario-spacing", "5"], "--scenario-spacing 5: must be 0 for no scenarios, or 20 m"),
        (["--scenario-spacing", "nan"], "--scenario-spacing nan: must be 0"),
        (["--map", "nowhere"], "nowhere: is neither an OpenDRIVE file nor a bundled town"),
    ],
)
def test_make_refuses_what_makes_no_sense(tmp_path, capsys, arguments, reason):
    line = refused(capsys, "make", tmp_path / "bank.npz", *MAKE, *arguments)
    assert line.startswith(reason)
    assert list(tmp_path.iterdir()) == []


def test_make_writes_nothing_for_a_bad_map_or_place(tmp_path, capsys):
    broken = tmp_path / "broken.xodr"
    broken.write_text("<OpenDRIVE>")
    line = refused(capsys, "make", tmp_path / "bank.npz", *MAKE, "--map", broken)
    assert line.startswith(f"{broken}: is not well-formed XML")
    copy = tmp_path / "village.xodr"
    shutil.copy(towns.path("village"), copy)
    line = refused(capsys, "make", copy, *MAKE, "--map", copy)
    assert line == f"{copy}: is the map, won't overwrite it"
    (tmp_path / "file").write_text("")
    refused(capsys, "make", tmp_path / "file" / "bank.npz", *MAKE, "--num", "1")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"broken.xodr", "village.xodr", "file"}


def test_a_bank_of_another_map_is_refused(bank, tmp_path):
    other = tmp_path / "village.xodr"
    other.write_text(towns.path("village").read_text().replace("<OpenDRIVE>", "<OpenDRIVE >"))
    with pytest.raises(BankError, match=r"was made for the map village with SHA-256 [0-9a-f]{12}"):
        route_bank.load(bank, town_module.load(other), other)


def test_a_bank_of_other_lane_numbers_is_refused(bank, village):
    moved = dataclasses.replace(village.lanes, raw_lane=np.roll(village.lanes.raw_lane, 1))
    other = dataclasses.replace(village, lanes=moved)
    with pytest.raises(BankError, match="numbered the lanes of village in another way; make it"):
        route_bank.load(bank, other, towns.path("village"))


DAMAGES = {
    "format": ({"format": np.int64(99)}, "is a bank of format 99, this version reads 1"),
    "no format": ({"format": None}, "is not a bank of routes: it has no format"),
    "no seed": ({"origin.seed": None}, "is damaged: it does not say its seed"),
    "no points": ({"route.xy": None}, "is damaged or of another version: route.xy is amiss"),
    "fewer": ({"route.s": np.zeros((1, 9), np.float32)}, "is damaged or of another version: route"),
    "no cars": (
        {"scenario.cars.model": None},
        "is damaged or of another version: scenario.cars.model is amiss",
    ),
    "kinds": (
        {"kinds": np.array(["Earthquake"])},
        "has scenarios of a kind that is not here: Earthquake",
    ),
}


@pytest.mark.parametrize("damage", sorted(DAMAGES))
def test_a_damaged_bank_is_refused_in_one_line(bank, village, tmp_path, damage):
    changes, reason = DAMAGES[damage]
    path = rewritten(bank, tmp_path / "bank.npz", **changes)
    with pytest.raises(BankError) as caught:
        route_bank.load(path, village, towns.path("village"))
    assert str(caught.value).startswith(f"{path}: {reason}")


@pytest.mark.parametrize("damage", ["cut", "text", "empty", "folder", "missing", "pickle"])
def test_what_is_no_bank_is_refused_in_one_line(bank, tmp_path, capsys, damage):
    path = tmp_path / "bank.npz"
    if damage == "cut":
        path.write_bytes(bank.read_bytes()[:5000])
    elif damage in ("text", "empty"):
        path.write_text("hello" if damage == "text" else "")
    elif damage == "folder":
        path.mkdir()
    elif damage == "pickle":
        np.savez(path, format=np.array([{}], object), kinds=np.array(["a"]))
    for command in (["info", path], ["draw", path, tmp_path / "x.png"]):
        assert refused(capsys, *command).startswith(f"{path}: is not ")
    assert not (tmp_path / "x.png").exists()


def test_kinds_are_kept_by_name_not_by_number(bank, village, monkeypatch):
    before = route_bank.load(bank, village, towns.path("village"))
    names = [registry.KINDS[int(s.kind)] for one in before for s in one.scenarios]
    turned = registry.KINDS[::-1]
    monkeypatch.setattr(registry, "KINDS", turned)
    after = route_bank.load(bank, village, towns.path("village"))
    assert [turned[int(s.kind)] for one in after for s in one.scenarios] == names


def test_info(bank, capsys):
    assert routes.main(["info", str(bank), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert (values["num_routes"], values["seed"], values["map_name"]) == (NUM, SEED, "village")
    assert values["scenarios"] == sum(values[kind] for kind in registry.KINDS) > 0
    assert values["km"] == pytest.approx(NUM * LENGTH / 1000, abs=0.15)
    assert routes.main(["info", str(bank)]) == 0
    assert f"{'num_routes':<32} {NUM}\n" in capsys.readouterr().out


def test_draw_paints_the_route(bank, tmp_path, capsys):
    path = tmp_path / "route.png"
    assert routes.main(["draw", str(bank), str(path), "--route", "2", "--pixels", "600"]) == 0
    with Image.open(path) as image:
        picture = np.asarray(image.convert("RGB")).astype(int)
    # The route's colour is the only strong blue of the picture.
    assert ((picture[..., 2] - picture[..., 0]) > 90).sum() > 100
    assert picture.shape[1] == 600
    assert capsys.readouterr().out == f"{path}\n"
    for arguments, reason in (
        (["--route", str(NUM)], f"--route {NUM}: {bank} has routes 0 to {NUM - 1}"),
        (["--route", "first"], "--route first: "),
        (["--maps", str(tmp_path)], "--maps and --triggers go with a route file"),
        (["--map", "grid"], f"{bank}: was made for the map village"),
        (["--pixels", "7"], "--pixels 7: must be from 100 to 20000"),
    ):
        assert refused(capsys, "draw", bank, tmp_path / "y.png", *arguments).startswith(reason)
    assert refused(capsys, "draw", bank, tmp_path / "y.bmp").startswith(f"{tmp_path / 'y.bmp'}: is")
    assert {entry.name for entry in tmp_path.iterdir()} == {"route.png"}


def config_of(*banks, maps=("village",)):
    files = tuple(towns.path(name) for name in maps)
    return TrainConfig(run=RunConfig(maps=files, routes=banks))


def test_training_reads_banks_into_the_tables_that_towns_share(bank, village):
    config = config_of(bank, maps=("highway", "village"))
    loaded = [town_module.load(path) for path in config.run.maps]
    other = route_bank.origin(loaded[0], config.run.maps[0], 2, 0, LENGTH, SPACING)
    path = bank.with_name("highway.npz")
    route_bank.save(path, route_bank.make(loaded[0], other), other)
    read = build.read_banks(config_of(bank, path, maps=("highway", "village")), loaded)
    assert [int(one.route.town) for one in read] == [1] * NUM + [0] * 2
    own = route_bank.load(bank, village, towns.path("village"))
    first = town_module.offsets(loaded)[1]
    for one, before in zip(read[:NUM], own, strict=True):
        np.testing.assert_array_equal(one.route.lane - before.route.lane, first.lane)
        for scenario, alone in zip(one.scenarios, before.scenarios, strict=True):
            used = alone.cars.lanes >= 0
            moved = scenario.cars.lanes - alone.cars.lanes
            np.testing.assert_array_equal(moved, np.where(used, first.lane, 0))
    with pytest.raises(ConfigError, match=r"there is no bank for .*highway\.xodr, one of this"):
        build.read_banks(config, loaded)


@pytest.mark.parametrize("damage", ["other map", "missing"])
def test_training_refuses_other_banks(bank, tmp_path, damage):
    path = bank if damage == "other map" else tmp_path / "none.npz"
    config = config_of(path, maps=("grid",))
    with pytest.raises(ConfigError, match=f"^run.routes: {path}: "):
        build.read_banks(config, [town_module.load(towns.path("grid"))])


ROUTE_FILE = """<routes><route id="a" town="village"><waypoints>{}</waypoints><scenarios>
<scenario type="HardBreakRoute" name="far"><trigger_point x="9999" y="0" yaw="0"/></scenario>
<scenario type="Earthquake" name="odd"><trigger_point x="0" y="0" yaw="0"/></scenario>
<scenario type="ControlLoss" name="on"><trigger_point {}/></scenario>
</scenarios></route></routes>"""


@pytest.fixture
def route_file(bank, village, tmp_path):
    """A route file in CARLA's frame, made of every 20th point of a drawn route."""
    route = route_bank.load(bank, village, towns.path("village"))[0].route
    xy = route.xy.astype(float) + village.offset
    points = "".join(f'<position x="{x!r}" y="{-y!r}"/>' for x, y in xy[::20].tolist())
    x, y = xy[100].tolist()
    yaw = float(-np.degrees(route.yaw[100]))
    path = tmp_path / "routes.xml"
    path.write_text(ROUTE_FILE.format(points, f'x="{x!r}" y="{-y!r}" yaw="{yaw!r}"'))
    return path


def test_check_reports_on_every_scenario(route_file, capsys, tmp_path):
    maps = str(towns.path("village").parent)
    assert routes.main(["check", str(route_file), "--maps", maps, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    (row,) = values["routes"]
    # The drawn route's 400 m.
    assert row["length_m"] == pytest.approx(LENGTH, abs=8.0)
    assert (row["placed"], row["scenarios"]) == (1, 3)
    far, odd, on = values["scenarios"]
    assert "off the route" in far["reason"]
    assert odd["reason"] == "there is no such kind of scenario here"
    assert on["kind"] == "ControlLoss" and on["away_m"] < 1.0
    assert on["trigger_m"] == pytest.approx(100.0, abs=4.0)
    assert routes.main(["check", str(route_file), "--maps", maps]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + 3 + 1
    assert lines[-1] == "1 routes, 1 of 3 scenarios placed"
    picture = tmp_path / "a.png"
    arguments = ["draw", str(route_file), str(picture), "--route", "a", "--maps", maps]
    assert routes.main([*arguments, "--pixels", "300"]) == 0
    assert picture.exists()


def test_check_refuses_in_one_line(route_file, tmp_path, capsys):
    maps = towns.path("village").parent
    line = refused(capsys, "check", route_file, "--maps", tmp_path)
    assert line == f"{route_file}: route a: its map {tmp_path / 'village.xodr'} is not there"
    line = refused(capsys, "check", tmp_path / "none.xml", "--maps", maps)
    assert line == f"{tmp_path / 'none.xml'}: can't be read: No such file or directory"
    text = route_file.read_text()
    route_file.write_text(text.replace("<position ", '<position x="5000" y="0"/><position ', 1))
    line = refused(capsys, "check", route_file, "--maps", maps)
    assert line.startswith(f"{route_file}: route a: waypoint 0 is on no driving lane")
    assert refused(capsys, "draw", route_file, tmp_path / "x.png") == (
        "a route file takes --maps DIR, and no --map"
    )


def test_as_a_command(tmp_path):
    def run(*args):
        return subprocess.run(
            [sys.executable, "-m", "carljax.routes", *args],
            capture_output=True,
            text=True,
            timeout=120,
        )

    done = run("info", str(tmp_path / "none.npz"))
    assert done.returncode == 2
    assert done.stderr == f"error: {tmp_path / 'none.npz'}: is not there, or no file\n"
    assert run("make").returncode == 2
