"""The bird's-eye view: hand-made scenes, random ones against a float64 oracle, symmetries."""

from __future__ import annotations

import dataclasses
import functools
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import raster_oracle
from crossing_world import agents_of, ego_at, road_map, route_east, with_pictures

from carljax.sim import raster_canvas, raster_users, rasterizer
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.road_map import picture
from carljax.sim.types import (
    DOOR_FRONT_LEFT,
    DOOR_REAR_RIGHT,
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_YELLOW,
    SIGNAL_BRAKE,
    SIGNAL_EMERGENCY,
    SIGNAL_LEFT,
    SIGNAL_RIGHT,
    STOP_LIGHT,
    STOP_SIGN,
    STOP_YIELD,
)

CONFIG = RasterConfig()
SMALL = RasterConfig(height=64, width=64, pixels_per_metre=1.0, ego_from_bottom_px=16)
CAR = {"length": 4.0, "width": 2.0, "kind": KIND_VEHICLE}
ROAD, ROUTE, LINES, CARS, WALKERS, LIGHTS, STOP, SIGNS, STATIC, SHOULDER = range(10)


@pytest.fixture(scope="module")
def world():
    return road_map()


@functools.partial(jax.jit, static_argnames="config")
def _render(ego, agents, world, route, idx, colour, left, satisfied, config):
    return rasterizer.render(ego, agents, world, route, idx, colour, left, satisfied, config)


def draw(world, ego, agents=None, route=None, idx=0, config=CONFIG, **signals):
    """The image as int, with nobody else on the road unless said."""
    agents = agents_of() if agents is None else agents
    route = route_east() if route is None else route
    num = len(route.stop_kind)
    colour = jnp.asarray(signals.get("colour", [LIGHT_GREEN] * num), jnp.int32)
    left = jnp.asarray(signals.get("left", [0.0] * num), jnp.float32)
    satisfied = jnp.asarray(signals.get("satisfied", [False] * num))
    image = _render(ego, agents, world, route, jnp.int32(idx), colour, left, satisfied, config)
    assert image.dtype == jnp.uint8 and image.shape == config.shape
    return np.asarray(image).astype(int)


def cells(channel):
    """{(row, column): value} of what is drawn."""
    return {(int(r), int(c)): int(channel[r, c]) for r, c in np.argwhere(channel)}


def block(rows, columns, value):
    return {(r, c): value for r in rows for c in columns}


def test_road_lines_and_shoulder_beside_an_ego_on_the_western_arm(world):
    # Heading east at y = -1.75; column c looks at y = -1.75 + (127.5 - c) / 2, row 155 at x = -60.
    image = draw(world, ego_at(-60.25, -1.75))
    y = -1.75 + (127.5 - np.arange(256)) / 2
    sure = np.abs(np.abs(y) - 3.5) > 0.01  # on the very edge either side may own the pixel
    road, shoulder = np.abs(y) < 3.5, (y > -5.5) & (y < -3.5)
    np.testing.assert_array_equal(image[155, sure, ROAD], 255 * road[sure])
    sure &= np.abs(y + 5.5) > 0.01
    np.testing.assert_array_equal(image[155, sure, SHOULDER], 255 * shoulder[sure])
    broken, solid = image[155, :, LINES] == 127, image[155, :, LINES] == 255
    # Lines are 1 m wide: those on 0 and +-3.5 m cover two pixels each.
    assert set(y[broken]) <= {-0.5, 0.0, 0.5} and broken.sum() == 2
    assert set(np.abs(y[solid])) <= {3.0, 3.5, 4.0} and solid.sum() == 4
    # From row 55 up to row 15 lies the crossing: no shoulder, a road across, and no line but for
    # the half width by which each is longer.
    assert not image[17:54, 118:131, LINES].any() and image[35, 30:226, ROAD].all()
    assert not image[16:55, :, SHOULDER].any()


def test_beyond_the_town_and_in_the_empty_town_there_is_nothing(world):
    assert not draw(world, ego_at(900.0, 0.0)).any()
    ghost = route_east(town=np.int32(0), in_junction=np.zeros(201, bool))
    assert not draw(world, ego_at(-60.25, -1.75), route=ghost).any()


def test_a_car_ahead_with_its_forecast_line(world):
    # 20.1 m ahead, 0.1 m left: rows 156 - 2 (20.1 +- 2) = 111.8 ... 119.8, columns
    # 128 - 2 (0.1 +- 1) = 125.8 ... 129.8; 112 ... 119 and 126 ... 129 have their centre inside.
    # 10 m/s: 127 + int(128 * 12.67 / 36) = 127 + 45. Line: 10 m from row 111.8 up, column 127.8.
    car = CAR | {"x": -40.15, "y": -1.65, "speed": 10.0}
    image = draw(world, ego_at(-60.25, -1.75), agents_of(car))
    expected = block(range(112, 120), range(126, 130), 172) | block(range(91, 112), [127], 172)
    assert cells(image[..., CARS]) == expected
    assert not image[..., [WALKERS, STATIC, LIGHTS, STOP, SIGNS]].any()


def test_a_parked_car_on_the_left_facing_left_has_a_short_line(world):
    # 10.1 m left, across: columns 128 - 2 (10.1 +- 2) = 103.8 ... 111.8, rows 155.8 - 2 ... 157.8;
    # at rest 127 + int(128 * 2.67 / 36) = 136; the line is 0.5 m: columns 103.8 and 102.8.
    car = CAR | {"x": -60.15, "y": 8.35, "yaw": math.pi / 2}
    image = draw(world, ego_at(-60.25, -1.75), agents_of(car))
    expected = block(range(154, 158), range(104, 112), 136) | block([155], [102, 103], 136)
    assert cells(image[..., CARS]) == expected


def test_the_brake_light(world):
    # The light is 1 m square, 1.5 m behind the centre: rows 156 - 2 (18.6 +- 0.5) = 117.8 ...
    # 119.8, columns 126.8 ... 128.8.
    car = CAR | {"x": -40.15, "y": -1.65, "signals": SIGNAL_BRAKE}
    image = draw(world, ego_at(-60.25, -1.75), agents_of(car))[..., CARS]
    assert cells(np.where(image == 111, image, 0)) == block([118, 119], [127, 128], 111)
    assert image[118, 126] == image[117, 127] == 136
    image = draw(world, ego_at(-60.25, -1.75), agents_of(car | {"signals": 0}))[..., CARS]
    assert 111 not in image


@pytest.mark.parametrize(
    ("signal", "value", "rows", "columns"),
    [
        # 1 m square at (0.5, 0.5) ahead and left of the centre, which is at row 115.8, column
        # 127.8: rows 113.8 ... 115.8, columns 125.8 ... 127.8; to the right 127.8 ... 129.8; on the
        # centre rows 114.8 ... 116.8, columns 126.8 ... 128.8.
        (SIGNAL_LEFT, 44, [114, 115], [126, 127]),
        (SIGNAL_RIGHT, 77, [114, 115], [128, 129]),
        (SIGNAL_EMERGENCY, 22, [115, 116], [127, 128]),
    ],
)
def test_indicators_and_emergency_lights(world, signal, value, rows, columns):
    car = CAR | {"x": -40.15, "y": -1.65, "signals": signal}
    image = draw(world, ego_at(-60.25, -1.75), agents_of(car))[..., CARS]
    assert cells(np.where((image > 0) & (image < 127), image, 0)) == block(rows, columns, value)


@pytest.mark.parametrize(
    ("door", "rows", "columns"),
    [
        # 0.4 m by 2 m across at (0.7, 1.8): rows 114 ... 114.8 hold the centre of row 114,
        # columns 127.8 - 2 (1.8 +- 1) = 122.2 ... 126.2; what the box of the car (126 on) hides
        # is coded alike. At (-0.7, -1.8): row 116.8 ... 117.6, columns 129.4 ... 133.4.
        (DOOR_FRONT_LEFT, [114], range(122, 126)),
        (DOOR_REAR_RIGHT, [117], range(130, 133)),
    ],
)
def test_an_open_door_sticks_out(world, door, rows, columns):
    car = CAR | {"x": -40.15, "y": -1.65}
    shut, open_ = (
        cells(draw(world, ego_at(-60.25, -1.75), agents_of(car | {"signals": s}))[..., CARS])
        for s in (0, door)
    )
    assert {place: v for place, v in open_.items() if place not in shut} == block(
        rows, columns, 136
    )


def test_a_bus_is_drawn_whole_and_many_lorries_at_least_in_part(world):
    # 10.3 m: rows 115.8 -+ 10.3 = 105.5 ... 126.1.
    bus = CAR | {"x": -40.15, "y": -1.65, "length": 10.3, "width": 2.6}
    image = draw(world, ego_at(-60.25, -1.75), agents_of(bus))[..., CARS]
    assert (image[106:126, 126:130] == 136).all() and not image[127:].any()
    convoy = [bus | {"y": -60.0 + 10 * k} for k in range(12)]
    image = draw(world, ego_at(-60.25, -1.75), agents_of(*convoy, slots=12))[..., CARS]
    columns = (128 + 2 * (58.25 - 10 * np.arange(12))).astype(int)
    assert (image[110:121, columns] == 136).all()
    assert (image[106:126, columns] == 136).all(axis=0).sum() == raster_users.NUM_LARGE


def test_pedestrians_and_obstacles_have_their_own_channels(world):
    # A pedestrian is drawn 1.6 m square: rows 156 - 2 (10.1 +- 0.8) = 134.2 ... 137.4 of which
    # 134 ... 136 have their centre inside, columns 128 - 2 (-3.1 +- 0.8) = 132.6 ... 135.8.
    walker = {"x": -50.15, "y": -4.85, "length": 0.4, "width": 0.4, "kind": KIND_PEDESTRIAN}
    crate = {"x": -50.15, "y": 4.35, "length": 1.0, "width": 1.0, "kind": KIND_STATIC}
    image = draw(world, ego_at(-60.25, -1.75), agents_of(walker, crate))
    line = block([133, 134], [134], 136)
    assert cells(image[..., WALKERS]) == block(range(134, 137), range(133, 136), 136) | line
    # The crate keeps its size: rows 134.8 ... 136.8, columns 128 - 2 (6.1 +- 0.5) = 114.8 ...
    assert cells(image[..., STATIC]) == block([135, 136], [115, 116], 255)
    assert not image[..., CARS].any()


def test_who_is_on_the_bridge_above_or_not_there_is_not_drawn(world):
    above = CAR | {"x": -40.0, "y": -1.65, "z": 8.1}
    gone = CAR | {"x": -50.0, "y": -1.65, "kind": 0}
    assert not draw(world, ego_at(-60.25, -1.75), agents_of(above, gone))[..., CARS].any()
    assert draw(world, ego_at(-60.25, -1.75), agents_of(above | {"z": -7.9}))[..., CARS].any()


@pytest.mark.parametrize("px", [1.0, 2.0, 5.0])
def test_no_box_shows_a_hole_at_any_angle(world, px):
    config = dataclasses.replace(CONFIG, pixels_per_metre=px, height=70, width=70)
    config = dataclasses.replace(config, ego_from_bottom_px=35)
    row, column = np.mgrid[:70, :70] + 0.5
    rng = np.random.default_rng(0)
    for yaw in rng.uniform(-3.1, 3.1, 40):
        length, width = rng.uniform(1.6, 6.0), rng.uniform(1.6, 2.4)
        x, y = rng.uniform(-2, 2, 2)
        user = {"x": x, "y": y, "yaw": yaw, "length": length, "width": width}
        image = draw(
            world, ego_at(0, 0), agents_of(user | {"kind": KIND_STATIC}, slots=1), config=config
        )
        # Depth of each pixel's centre within the box, px.
        dx, dy = (35 - row) / px - x, (35 - column) / px - y
        along = length / 2 - np.abs(np.cos(yaw) * dx + np.sin(yaw) * dy)
        across = width / 2 - np.abs(np.cos(yaw) * dy - np.sin(yaw) * dx)
        depth = np.minimum(along, across) * px
        assert image[depth > 0.51, STATIC].all()
        # A sample half a pixel inside lies at most 0.71 px from its pixel's centre.
        assert not image[depth < -0.22, STATIC].any()


def test_the_route_shows_in_the_crossing_only_or_everywhere(world):
    ego = ego_at(-30.3, -1.65)
    inside = draw(world, ego, idx=70)[..., ROUTE]
    # In the crossing lie x = -10 ... 10: rows 156 - 2 * 20.3 = 115.4 to 75.4; discs of 3 px.
    rows = np.flatnonzero(inside.any(axis=1))
    assert (rows.min(), rows.max()) == (75 - 3, 115 + 3)
    assert set(np.flatnonzero(inside.any(axis=0))) == set(range(128 - 3, 128 + 4))
    everywhere = dataclasses.replace(CONFIG, route_everywhere=True)
    whole = draw(world, ego, idx=70, config=everywhere)[..., ROUTE]
    # From the point passed last, 0.3 m ahead in row 155, to the top; what lies behind is not drawn.
    assert whole[:159, 128].all() and not whole[159:].any()


def test_the_route_ends_at_its_last_point(world):
    everywhere = dataclasses.replace(CONFIG, route_everywhere=True)
    short = route_east(num_points=np.int32(91))  # to x = -10
    image = draw(world, ego_at(-30.3, -1.65), route=short, idx=70, config=everywhere)[..., ROUTE]
    assert np.flatnonzero(image.any(axis=1)).min() == 115 - 3


def stops(kinds, idxs, width=3.5):
    """A route with stop lines at some of its points."""
    idxs = np.array(idxs, np.int32)
    num = len(idxs)
    return route_east(
        stop_idx=idxs,
        stop_xy=np.stack([idxs - 100.0, np.full(num, -1.75)], axis=-1),
        stop_yaw=np.zeros(num),
        stop_s=idxs.astype(float),
        stop_kind=np.array(kinds, np.int32),
        stop_light=np.zeros(num, np.int32),
        stop_width=np.full(num, width),
    )


@pytest.mark.parametrize(
    ("colour", "left", "value"),
    [
        (LIGHT_GREEN, 0.0, 80),
        (LIGHT_RED, 0.0, 255),
        (LIGHT_YELLOW, 3.0, 170),  # int(255 * 0.67) = int(170.85)
        (LIGHT_YELLOW, 1.5, 212),  # int(255 * (1 - 0.165)) = int(212.925)
        (LIGHT_YELLOW, 0.0, 255),
    ],
)
def test_a_light_shows_as_its_stop_line(world, colour, left, value):
    image = draw(
        world, ego_at(-30.05, -1.85), route=stops([STOP_LIGHT], [90]), idx=70, colour=[colour],
        left=[left],
    )  # fmt: skip
    # The line at x = -10 is 1.5 m thick, rows 156 - 2 (20.05 +- 0.75) = 114.4 ... 117.4, and 0.8
    # lanes wide, columns 128 - 2 (0.1 +- 1.4) = 125.0 ... 130.6.
    assert cells(image[..., LIGHTS]) == block(range(114, 117), range(125, 131), value)


def test_lights_far_behind_or_ahead_and_other_stop_lines_are_not_lights(world):
    route = stops([STOP_LIGHT, STOP_LIGHT, STOP_SIGN, STOP_YIELD], [50, 81, 90, 95])
    seen = draw(world, ego_at(-30.05, -1.85), route=route, idx=70)[..., LIGHTS]
    # The light at point 50 was passed 20 points ago; 81 lies in rows 156 - 2 (11.05 +- 0.75).
    assert list(np.flatnonzero(seen.any(axis=1))) == [132, 133, 134]
    assert not draw(world, ego_at(-19.05, -1.85), route=route, idx=101)[..., LIGHTS].any()
    assert draw(world, ego_at(-19.05, -1.85), route=route, idx=100)[..., LIGHTS].any()


def test_a_light_is_drawn_up_to_149_route_points_ahead(world):
    route = stops([STOP_LIGHT], [90])  # a winding route: near, but far along it
    for ahead, seen in ((149, True), (150, False)):
        bent = route.replace(stop_idx=jnp.array([70 + ahead]))
        image = draw(world, ego_at(-30.05, -1.85), route=bent, idx=70)
        assert image[..., LIGHTS].any() == seen


def test_150_route_points_are_looked_at_or_what_a_small_image_can_show():
    assert CONFIG.num_route_points == 150
    # The farthest corner is hypot(48, 32) = 57.7 m away: 1.5 times that.
    assert SMALL.num_route_points == 87


def test_only_the_next_stop_sign_that_asks_for_a_halt_is_drawn(world):
    route = stops([STOP_SIGN, STOP_SIGN, STOP_LIGHT, STOP_SIGN], [88, 80, 75, 140])
    ego = ego_at(-30.05, -1.85)

    def rows(idx, satisfied):
        image = draw(world, ego, route=route, idx=idx, satisfied=satisfied)[..., STOP]
        return sorted(set(np.flatnonzero(image.any(axis=1))))

    # A square of 3.5 m at 10.05 or 18.05 m: rows 132.4 ... 139.4 or 116.4 ... 123.4.
    assert rows(70, [False] * 4) == list(range(132, 139))
    assert rows(70, [False, True, False, False]) == list(range(116, 123))
    assert rows(70, [True, True, False, False]) == []
    assert rows(60, [False] * 4) == list(range(132, 139))  # 20 points ahead, still seen
    assert rows(59, [False] * 4) == []


def test_speed_signs_code_their_limit(world):
    route = route_east(
        sign_xy=np.array([[-20.0, -5.0], [-24.0, -5.0], [0.0, 0.0]]),
        sign_idx=np.array([80, 40, -1], np.int32),
        sign_limit=np.array([50 / 3.6, 30 / 3.6, 0.0]),
    )
    image = draw(world, ego_at(-30.05, -1.85), route=route, idx=70)[..., SIGNS]
    # 10.05 m ahead, 3.15 m right, 2 m square: rows 133.9 ... 137.9, columns 132.3 ... 136.3;
    # 50 km/h: 127 + int(128 * 16.559 / 36) = 127 + 58. The sign passed 30 points ago is not drawn.
    assert cells(image) == block(range(134, 138), range(132, 136), 185)


def random_scene(seed, slots=24):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-40, 10), rng.uniform(-3, 3)
    ego = ego_at(x, y, rng.uniform(-3.1, 3.1))
    users = [
        {
            "x": x + rng.uniform(-40, 40),
            "y": y + rng.uniform(-40, 40),
            "yaw": rng.uniform(-3.1, 3.1),
            "length": rng.uniform(3.6, 6.0) if kind == KIND_VEHICLE else rng.uniform(0.5, 2.0),
            "width": rng.uniform(1.6, 2.4) if kind == KIND_VEHICLE else rng.uniform(0.5, 2.0),
            "kind": kind,
            "speed": rng.uniform(0, 20) if kind != KIND_STATIC else 0.0,
            "signals": int(rng.choice([0, *range(1, 9), 16, 32, 64, 128])),
            "z": rng.uniform(-9, 9),
        }
        for kind in rng.choice([1, 1, 1, 2, 3], slots)
    ]
    route = stops([STOP_LIGHT, STOP_SIGN, STOP_LIGHT, STOP_SIGN], [85, 75, 120, 90])
    route = route.replace(
        sign_xy=jnp.asarray(rng.uniform(-40, 20, (3, 2)), jnp.float32),
        sign_idx=jnp.array([70, 90, -1]),
        sign_limit=jnp.array([8.0, 14.0, 0.0], jnp.float32),
        stop_yaw=jnp.asarray(rng.uniform(-3, 3, 4), jnp.float32),
    )
    signals = {
        "colour": rng.integers(0, 3, 4),
        "left": rng.uniform(0, 3, 4),
        "satisfied": rng.random(4) < 0.4,
    }
    return ego, agents_of(*users, slots=slots), route, signals


@pytest.mark.parametrize(
    ("length", "width"),
    [(11.0, 3.8), (19.8, 4.2), (1.0, 1.0), (0.5, 3.8), (3.8, 0.5), (0.0, 3.0), (3.0, 0.0), (0, 0)],
)
def test_no_place_in_a_box_is_half_a_pixel_from_all_samples(length, width):
    # A grid would take steps of 0.7 px both ways: half a pixel is half of its cell's diagonal.
    points = raster_canvas._samples(length, width)
    assert points.shape[1] <= (np.ceil(length / 0.7) + 1) * (np.ceil(width / 0.7) + 1) + 1
    size = np.array([length, width]) / 2
    places = np.stack(np.meshgrid(*np.linspace(-size, size, 150).T), axis=-1).reshape(-1, 1, 2)
    away = np.linalg.norm(places - points.T * size, axis=-1)
    assert away.min(axis=1).max() <= 0.5
    assert np.abs(points).max() <= 1.0


@pytest.mark.parametrize("config", [CONFIG, SMALL], ids=["256 at 2 px/m", "64 at 1 px/m"])
@pytest.mark.parametrize("seed", [0, 1])
def test_random_scenes_match_the_oracle(world, config, seed):
    config = dataclasses.replace(config, route_everywhere=seed == 1)
    ego, agents, route, signals = random_scene(seed)
    image = draw(world, ego, agents, route, idx=70, config=config, **signals)
    layers, origin = picture(world, 1, world.layers), np.asarray(world.origin[1])
    expected = raster_oracle.render(
        ego, agents, layers, origin, route, 70, signals["colour"], signals["left"],
        signals["satisfied"], config,
    )  # fmt: skip
    assert (image == expected).all(axis=-1).mean() > 0.99
    # That says little of small things: what both draw must be most of what either does.
    for channel in range(10):
        ours, theirs = image[..., channel], expected[..., channel]
        both = np.count_nonzero((ours == theirs) & (theirs > 0))
        either = np.count_nonzero(ours | theirs)
        least = 0.999 if channel in (ROAD, ROUTE, LINES, SHOULDER) else 0.9
        assert both >= least * either - 3, raster_canvas.CHANNELS[channel]
    assert np.count_nonzero(expected.any(axis=(0, 1))) >= 8


def quarter_turn(world, ego, agents, route, shift):
    """The same scene, turned left by 90 degrees around the origin and then moved."""

    def turn(xy):
        return jnp.stack([-xy[..., 1], xy[..., 0]], axis=-1) + jnp.asarray(shift)

    quarter = jnp.float32(math.pi / 2)
    layers = np.stack([picture(world, number, world.layers) for number in range(2)])
    # Column 0 of the turned picture was the last row.
    height = (layers.shape[1] - 1) / 2
    origin = turn(world.origin + jnp.array([0.0, height]))
    layers = np.swapaxes(layers[:, ::-1], 1, 2)  # row' = column, column' = last - row
    return (
        with_pictures(world, layers, origin),
        ego.replace(xy=turn(ego.xy), yaw=ego.yaw + quarter),
        agents.replace(xy=turn(agents.xy), yaw=agents.yaw + quarter),
        route.replace(
            xy=turn(route.xy),
            yaw=route.yaw + quarter,
            stop_xy=turn(route.stop_xy),
            stop_yaw=route.stop_yaw + quarter,
            sign_xy=turn(route.sign_xy),
        ),
    )


@pytest.mark.parametrize("seed", [2, 3])
def test_turning_and_moving_the_world_changes_nothing(world, seed):
    ego, agents, route, signals = random_scene(seed)
    first = draw(world, ego, agents, route, idx=70, **signals)
    scene = world, ego, agents, route
    for _ in range(3):
        scene = quarter_turn(*scene, shift=(13.0, -41.5))
        turned = draw(scene[0], *scene[1:], idx=70, **signals)
        # float32 puts a few places on the other side of a pixel's border.
        assert (turned != first).any(axis=-1).sum() <= 20
    # The same number would change if the scene were off by a millimetre or so; by half a pixel:
    moved = draw(world, ego.replace(xy=ego.xy + 0.25), agents, route, idx=70, **signals)
    assert (moved != first).any(axis=-1).sum() > 500


def test_a_coarse_image_keeps_thin_lines(world):
    # 0.25 px/m: a line of 1 m lies within one of four places looked at in each pixel of 4 m.
    config = RasterConfig(32, 32, 0.25, 8)
    image = draw(world, ego_at(-60.3, -1.75, 0.1), config=config)
    near = image[20:31, :, LINES]
    assert (near > 0).any(axis=1).all() and (near == 255).any() and (near == 127).any()


def test_a_batch_is_its_scenes_one_by_one(world):
    scenes = [random_scene(seed) for seed in (4, 5)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *[(e, a, r) for e, a, r, _ in scenes])
    signals = [
        jnp.stack([jnp.asarray(s[3][k]) for s in scenes]) for k in ("colour", "left", "satisfied")
    ]
    idx = jnp.full(2, 70, jnp.int32)

    def one(ego, agents, route, idx, colour, left, satisfied):
        return rasterizer.render(ego, agents, world, route, idx, colour, left, satisfied, SMALL)

    images = jax.jit(jax.vmap(one))(*batch, idx, *signals)
    for k, (ego, agents, route, rest) in enumerate(scenes):
        alone = draw(world, ego, agents, route, idx=70, config=SMALL, **rest)
        assert (alone != np.asarray(images[k])).any(axis=-1).mean() < 0.002


def test_one_trace_for_all_scenes(world):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def traced(ego, agents, route, idx):
        four = jnp.zeros(4, jnp.int32)
        return rasterizer.render(
            ego, agents, world, route, idx, four, four.astype(jnp.float32), four > 0, SMALL
        )

    for seed in (6, 7):
        ego, agents, route, _ = random_scene(seed)
        traced(ego, agents, route, jnp.int32(seed))


@pytest.mark.parametrize(
    ("speed", "value"),
    [(-9.0, 127), (0.0, 136), (13.9, 185), (33.33, 255), (60.0, 255)],
)
def test_speed_coding_at_known_speeds(speed, value):
    # 127 + int(128 * clip(v + 2.67, 0, 36) / 36): 2.67 -> 9.49, 16.57 -> 58.9, 36 -> 128.
    assert int(raster_users.speed_value(jnp.float32(speed))) == value
