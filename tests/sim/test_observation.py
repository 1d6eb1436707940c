"""The numbers beside the image, by hand; the whole observation in a real environment."""

from __future__ import annotations

import importlib.resources
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from crossing_world import ego_at

from carljax.render import image
from carljax.reward.config import RewardConfig
from carljax.sim import episodes, observation, rasterizer, situation, town
from carljax.sim.env import EnvConfig, make_env
from carljax.sim.population import Population
from carljax.sim.raster_canvas import CHANNELS, RasterConfig
from carljax.sim.types import SIGNAL_BRAKE


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_scalars_of_a_sliding_ego(wrap):
    ego = ego_at(3.0, 4.0, 1.0, speed=10.0, slip=math.asin(0.6), steer=-0.25, throttle=0.5)
    values = wrap(observation.scalars)(ego, jnp.float32(13.9))
    # sin(slip) = 0.6, cos(slip) = 0.8: 8 m/s ahead, 6 m/s to the left.
    others = [0, 1, 2, 4, 5, 6, 7]
    np.testing.assert_allclose(
        np.asarray(values)[others], [-0.25, 0.5, 0.0, 8.0, 6.0, 8.0, 13.9], rtol=1e-5
    )
    assert values.shape == (observation.NUM_SCALARS,) and values.dtype == jnp.float32


def test_the_gear_rises_with_speed_and_is_zero_at_rest():
    limit = jnp.float32(10.0)
    gears = [float(observation.scalars(ego_at(0, 0, speed=v), limit)[3]) for v in (0, 3, 9, 30)]
    assert gears[0] == 0.0 and sorted(set(gears)) == gears
    assert all(gear.is_integer() for gear in gears)


def test_braking_and_speed_limit_have_their_places():
    values = observation.scalars(ego_at(0, 0, brake=0.75), jnp.float32(6.0))
    np.testing.assert_allclose(np.asarray(values), [0, 0, 0.75, 0, 0, 0, 0, 6.0])


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_value_scalars_by_hand(wrap):
    values = wrap(observation.value_scalars)(
        elapsed_s=jnp.float32(300.0),
        time_limit_s=1200.0,
        stopped_s=jnp.float32(45.0),
        blocked_s=90.0,
        route_points_left=jnp.int32(850),
        ttc_ticks=jnp.int32(250),
        comfort_ticks=jnp.array([0, 500, 100, 50, 5, 1], jnp.int32),
    )
    # (1200 - 300) / 1200, (90 - 45) / 90, 850 / 100, 250 / 500, then comfort over 500.
    expected = [0.75, 0.5, 8.5, 0.5, 0.0, 1.0, 0.2, 0.1, 0.01, 0.002]
    np.testing.assert_allclose(np.asarray(values), expected, rtol=1e-6)
    assert values.shape == (observation.NUM_VALUE_SCALARS,) and values.dtype == jnp.float32


def painted(config, **channels):
    """The picture of a raster in which single pixels of row 2 are set, and the raster."""
    raster = np.zeros(config.shape, np.uint8)
    for column, (name, value) in enumerate(channels.items()):
        raster[2, column, CHANNELS.index(name)] = value
    return image.bev_image(raster, config)[2, : len(channels)]


def test_the_picture_gives_each_thing_its_colour():
    config = RasterConfig(height=40, width=30, pixels_per_metre=1.0, ego_from_bottom_px=10)
    seen = painted(config, road=255, route=255, shoulder=255, static=255, stop_sign=255)
    expected = [image.ROAD, image.ROUTE, image.SHOULDER, image.STATIC, image.STOP_SIGN]
    np.testing.assert_array_equal(seen, expected)
    for value, colour in ((80, image.GREEN), (170, image.YELLOW), (255, image.RED)):
        np.testing.assert_array_equal(painted(config, lights=value)[0], colour)
    for value, colour in (
        (127, image.VEHICLE[0]),
        (255, image.VEHICLE[1]),
        (111, image.VEHICLE_LIGHT[SIGNAL_BRAKE]),
    ):
        np.testing.assert_array_equal(painted(config, vehicles=value)[0], colour)


def test_the_picture_is_enlarged_and_shows_the_ego_where_it_is():
    config = RasterConfig(height=40, width=30, pixels_per_metre=2.0, ego_from_bottom_px=10)
    picture = image.bev_image(np.zeros(config.shape, np.uint8), config, 4, ego_size=(5.0, 2.0))
    assert picture.shape == (160, 120, 3) and picture.dtype == np.uint8
    # 5 x 2 m at 8 px/m around row 30 * 4 = 120 and column 60.
    rows, columns = np.nonzero((picture != image.GROUND).any(axis=-1))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (100, 139, 52, 67)


def test_a_raster_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"\(64, 64, 10\).*\(256, 256, 10\)"):
        image.bev_image(np.zeros((64, 64, 10), np.uint8), RasterConfig())


def test_the_map_picture_has_north_up():
    layers = np.zeros((6, 5), np.uint8)
    layers[0, 1] = 1  # the southernmost row
    picture = image.map_image(layers, 2)
    assert picture.shape == (12, 10, 3)
    np.testing.assert_array_equal(picture[10:, 2:4], np.broadcast_to(image.ROAD, (2, 2, 3)))
    np.testing.assert_array_equal(picture[0, 0], image.GROUND)


def test_an_environment_shows_the_route_from_where_the_ego_is():
    path = importlib.resources.files("carljax.sim.towns") / "village.xodr"
    bank = episodes.make_bank([town.load(path)], 1, Population(8, 0, 0), seed=3, route_length=400.0)
    config = RasterConfig(64, 64, 1.0, 16, route_everywhere=True)
    env = make_env(
        bank,
        EnvConfig(num_agents=8, num_pedestrians=0, num_scenario_slots=0, raster=config),
        RewardConfig(),
    )
    sim = jax.jit(env.start_episode)(jnp.int32(0), jax.random.key(0)).pipeline_state
    route = jax.tree.map(lambda x: x[0], bank.routes)
    memory = sim.reward_state.replace(stopped_s=jnp.float32(9.0), ttc_ticks=jnp.int32(50))
    sim = sim.replace(
        ego=sim.ego.replace(xy=route.xy[60], yaw=route.yaw[60]),
        route_idx=jnp.int32(60),
        step_count=jnp.int32(3000),
        reward_state=memory,
    )
    seen = jax.jit(observation.observe)(env, sim)
    # The environment looks at a window of the route; the whole route gives the same image.
    whole = jax.jit(rasterizer.render, static_argnames="config")(
        sim.ego,
        sim.agents,
        bank.road_map,
        route,
        sim.route_idx,
        situation.stop_lights(bank.road_map, route, sim.lights),
        situation.yellow_left(bank.road_map, route, sim.lights),
        memory.stop_satisfied,
        config=config,
    )
    assert (np.asarray(seen.raster) != np.asarray(whole)).any(axis=-1).sum() <= 4
    drawn = np.asarray(seen.raster)[..., CHANNELS.index("route")]
    assert drawn[46, 31] and drawn[:48].sum() > 255 * 30 and not drawn[51:].any()
    assert float(seen.scalars[7]) == float(route.speed_limit[60])
    # 300 of 1,200 s and 9 of 90 s are gone; the last point is num_points - 1.
    left = (int(route.num_points) - 61) / 100
    np.testing.assert_allclose(seen.value_scalars[:4], [0.75, 0.9, left, 0.1], rtol=1e-5)
