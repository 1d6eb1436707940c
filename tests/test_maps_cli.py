"""`python -m carljax.maps`: what it prints and writes, and what it leaves alone."""

import json
import subprocess
import sys

import numpy as np
import opendrive_files as of
import pytest
from PIL import Image

from carljax import maps
from carljax.sim import towns


@pytest.fixture
def town(tmp_path):
    """A street of 100 m with one lane of 3.5 m each way, a light, a crosswalk and a warning."""
    extra = (
        '<objects><object id="5" type="crosswalk" s="90" t="0" length="3" width="7"/>'
        '<object id="6" type="tree" s="10" t="9"/></objects>'
        '<signals><signal id="7" name="x" type="1000001" dynamic="yes" s="85" t="-5" '
        'orientation="+"/></signals>'
    )
    inner = '<roadMark sOffset="0" type="solid" color="yellow"/>'
    section = of.section([of.lane(1, inner=inner), of.lane(-1, inner=inner)])
    path = tmp_path / "street.xodr"
    path.write_text(of.document(of.road(3, 100.0, sections=section, extra=extra)))
    return path


def test_info_counts_what_is_there(town, capsys):
    assert maps.main(["info", str(town)]) == 0
    printed = capsys.readouterr()
    lines = {line[:26].strip(): line[26:].strip() for line in printed.out.splitlines()}
    assert lines["driving lanes"] == "2"
    assert lines["lane km"] == "0.2"
    assert lines["traffic lights"] == "1"
    assert lines["crosswalks"] == "1"
    assert lines["lane width m"] == "3.5, median 3.5, to 3.5"
    assert lines["x m"] == "0.0 to 100.0"
    assert lines["y m"] == "-1.8 to 1.8"
    assert lines["warnings"] == "1"
    assert printed.err.count("\n") == 1
    assert printed.err.startswith(f"{town}: warning: object")


def test_info_as_json(town, capsys):
    assert maps.main(["info", str(town), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["roads"] == 1
    assert values["lane width m"] == [3.5, 3.5, 3.5]


def test_lanes_writes_the_documented_arrays(town, tmp_path):
    out = tmp_path / "lanes.npz"
    assert maps.main(["lanes", str(town), str(out)]) == 0
    with np.load(out) as f:
        arrays = dict(f)
    np.testing.assert_array_equal(arrays["lane_key"], [(3, 0, 1), (3, 0, -1)])
    first, last = arrays["lane_ptr"][1:] - 1
    np.testing.assert_allclose(arrays["lane_xy"][[0, first]], [(100.0, 1.75), (0.0, 1.75)])
    np.testing.assert_allclose(arrays["lane_xy"][[first + 1, last]], [(0.0, -1.75), (100.0, -1.75)])
    assert len(arrays["lane_width"]) == len(arrays["lane_xy"]) == last + 1
    assert arrays["succ"].shape == (0, 2)
    assert not arrays["is_junction"].any()
    np.testing.assert_array_equal(arrays["crosswalk_ptr"], [0, 4])
    assert arrays["crosswalk_xy"].shape == (4, 2)
    assert arrays["signal_id"].tolist() == ["7"]


def test_links_are_written_as_rows_of_the_lanes(tmp_path):
    path, out = tmp_path / "town.xodr", tmp_path / "lanes.npz"
    path.write_text(of.FILES["crossing"])
    assert maps.main(["lanes", str(path), str(out)]) == 0
    with np.load(out) as f:
        key, succ, inside = f["lane_key"], f["succ"], f["is_junction"]
    links = {(*key[a].tolist(), *key[b].tolist()) for a, b in succ}
    assert (1, 0, 1, 11, 0, -1) in links
    assert (12, 0, -1, 1, 0, -1) in links
    assert len(links) == 7
    np.testing.assert_array_equal(inside, key[:, 0] > 10)


def test_road_ids_that_are_no_numbers_get_some(tmp_path):
    path, out = tmp_path / "town.xodr", tmp_path / "lanes.npz"
    path.write_text(of.document(of.road("4", 10.0), of.road("main", 10.0), of.road("side", 10.0)))
    assert maps.main(["lanes", str(path), str(out)]) == 0
    with np.load(out) as f:
        assert f["lane_key"][:, 0].tolist() == [4, 4, -1, -1, -2, -2]
        assert f["road_id"].tolist() == ["4", "4", "main", "main", "side", "side"]


def test_draw_paints_the_road_where_it_lies(town, tmp_path):
    out = tmp_path / "street.png"
    assert maps.main(["draw", str(town), str(out), "--pixels", "1160"]) == 0
    with Image.open(out) as image:
        picture = np.asarray(image.convert("RGB")).astype(int)[60:-60]  # no title, no legend
    # 100 m and a margin of 8 m either side on 1160 pixels: 10 pixels a metre.
    assert picture.shape[1] == 1160
    road = (picture == (0x58, 0x5C, 0x63)).all(axis=-1)
    columns = np.flatnonzero(road.any(axis=0))
    assert columns[0] == pytest.approx(80, abs=3)
    assert columns[-1] == pytest.approx(1080, abs=3)
    # At x = 20 m (column 280): 7 m of road but for the paint on its edges.
    assert road[:, 280].sum() == pytest.approx(70, abs=6)
    yellow = picture[:, 280, 0] - picture[:, 280, 2] > 50
    rows = np.flatnonzero(road[:, 280])
    np.testing.assert_allclose(np.flatnonzero(yellow)[[0, -1]], rows[[0, -1]], atol=4)
    # The zebra between x = 88.5 and 91.5 m.
    zebra = picture[rows[0] : rows[-1], 970:995].min(axis=-1)
    assert 0.2 < (zebra > 200).mean() < 0.8


def test_draw_names_its_picture_after_the_town(town, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert maps.main(["draw", str(town), "--pixels", "400"]) == 0
    assert (tmp_path / "street.png").exists()


@pytest.mark.parametrize("name", towns.names())
def test_bundled_towns_can_be_named(name, capsys):
    assert maps.main(["info", name, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["name"] == name
    assert values["lane km"] > 1.0


BROKEN = {
    "truncated": of.FILES["crossing"][:2000],
    "empty": "",
    "no number": of.FILES["crossing"].replace('x="20.0"', 'x="east"'),
    "unknown road": of.FILES["crossing"].replace('elementId="3"', 'elementId="33"'),
}


@pytest.mark.parametrize("command", ["info", "lanes", "draw"])
@pytest.mark.parametrize("damage", sorted(BROKEN))
def test_a_broken_file_prints_one_line_and_writes_nothing(tmp_path, capsys, command, damage):
    path = tmp_path / "town.xodr"
    path.write_text(BROKEN[damage])
    out = tmp_path / ("out.npz" if command == "lanes" else "out.png")
    out.write_text("what was there before")
    args = [command, str(path)] + ([] if command == "info" else [str(out)])
    assert maps.main(args) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(f"{path}: ")
    assert printed.err.count("\n") == 1
    assert out.read_text() == "what was there before"
    assert {p.name for p in tmp_path.iterdir()} == {path.name, out.name}


def test_what_cant_be_written_is_one_line_too(town, tmp_path, capsys):
    for out in (tmp_path / "nowhere" / "x.npz", tmp_path):
        assert maps.main(["lanes", str(town), str(out)]) == 2
        assert capsys.readouterr().err.splitlines()[-1].startswith(f"{out}: can't be written")
    assert maps.main(["lanes", str(town), str(town)]) == 2
    assert "won't overwrite" in capsys.readouterr().err
    assert maps.main(["draw", str(town), str(tmp_path / "x.bmp")]) == 2
    assert "must end in .png" in capsys.readouterr().err
    assert maps.main(["draw", str(town), str(tmp_path / "x.png"), "--pixels", "7"]) == 2
    assert "must be from 100" in capsys.readouterr().err
    assert {p.name for p in tmp_path.iterdir()} == {"street.xodr"}


def test_as_a_command(town, tmp_path):
    def run(*args):
        return subprocess.run(
            [sys.executable, "-m", "carljax.maps", *args],
            capture_output=True,
            text=True,
            timeout=120,
        )

    done = run("lanes", str(town), str(tmp_path / "x.npz"))
    assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'x.npz'}\n")
    done = run("info", str(tmp_path / "missing.xodr"))
    assert done.returncode == 2
    assert done.stderr == f"{tmp_path / 'missing.xodr'}: can't be read: No such file or directory\n"
    assert run("info").returncode == 2
