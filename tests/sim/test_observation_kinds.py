"""The kinds of observation in an environment: numbers by hand, equal trees, sizes, mistakes."""

from __future__ import annotations

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from crossing_world import ego_at

from carljax import config, presets, train
from carljax.ppo import obs_storage
from carljax.render import episode_view, image
from carljax.reward.config import RewardConfig
from carljax.sim import episodes, observation, observation_nuplan, raster_roach
from carljax.sim.env import EnvConfig, make_env
from carljax.sim.observation_roach import RoachOptions
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.raster_nuplan import NuplanOptions
from carljax.sim.types import PastMotion

SIZES = {"carla": (10, 8, 10), "roach": (15, 6, 3), "nuplan": (9, 10, 4)}
SMALL = RasterConfig(24, 16, 1.0, 6)


@pytest.fixture(scope="module")
def bank(bundled):
    return episodes.make_bank([bundled["grid"]], 2, env_config("carla").population, 1, 300.0)


def env_config(kind, **fields):
    values = {"num_agents": 4, "num_pedestrians": 2, "num_scenario_slots": 0, "raster": SMALL}
    return EnvConfig(observation=kind, **values | fields)


@pytest.fixture(scope="module", params=list(SIZES))
def env(request, bank):
    return make_env(bank, env_config(request.param), RewardConfig(time_limit_s=60.0))


@pytest.fixture(scope="module")
def step(env):
    chex.clear_trace_counter()
    return jax.jit(chex.assert_max_traces(lambda env, s, a: env.step(s, a), n=1))


def test_reset_and_step_give_equal_trees_of_the_kinds_sizes(env):
    first = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, first, jnp.zeros(2))
    chex.assert_trees_all_equal_structs(first, after)
    chex.assert_trees_all_equal_shapes_and_dtypes(first, after)
    weak = [[x.weak_type for x in jax.tree.leaves(tree)] for tree in (first, after)]
    assert weak[0] == weak[1]
    channels, scalars, value_scalars = SIZES[env.config.observation]
    assert first.obs.raster.shape == (24, 16, channels) == (24, 16, len(env.config.channels))
    assert first.obs.scalars.shape == (scalars,)
    assert first.obs.value_scalars.shape == (value_scalars,)


def test_a_batch_is_a_loop_and_one_trace_is_enough(env, step):
    states = [jax.jit(env.reset)(jax.random.key(seed)) for seed in (0, 1)]
    actions = jnp.array([[0.3, 0.8], [-0.2, 0.4]])
    batch = jax.jit(jax.vmap(env.step))(jax.tree.map(lambda *x: jnp.stack(x), *states), actions)
    for i, state in enumerate(states):
        alone = step(env, step(env, state, actions[i]), actions[i])  # traced once
        alone = step(env, state, actions[i])
        numbers = batch.obs.scalars[i], batch.obs.value_scalars[i]
        np.testing.assert_allclose(numbers[0], alone.obs.scalars, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(numbers[1], alone.obs.value_scalars, rtol=1e-5)
        other = np.asarray(batch.obs.raster[i]) != np.asarray(alone.obs.raster)
        assert other.any(axis=-1).mean() < 0.01


def test_what_a_rollout_keeps_is_seen_again_bit_for_bit(env, step):
    """In another batch size than it was drawn in, as the learner does it."""
    states = [jax.jit(env.reset)(jax.random.key(5))]
    for number in range(7):
        states.append(step(env, states[-1], jnp.array([0.1 * (number - 3), 0.9])))
    states = jax.tree.map(lambda *x: jnp.stack(x), *states)
    for channel, levels in zip(jnp.moveaxis(states.obs.raster, -1, 0), env.levels, strict=True):
        assert levels is None or set(np.unique(channel)) <= {0, *levels}
    image_bytes = states.obs.raster.nbytes
    for storage in (obs_storage.PACK, obs_storage.RERENDER):
        kept = jax.jit(jax.vmap(storage.keep, in_axes=(None, 0)))(env, states)
        part = jax.tree.map(lambda x: x[2:5], kept)
        again = jax.jit(jax.vmap(storage.recall, in_axes=(None, 0)))(env, part)
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[2:5]), again, states.obs)
        if storage is obs_storage.PACK:
            assert kept.raster.nbytes <= image_bytes * 5 / 9


def test_only_kinds_that_look_back_keep_something(env):
    state = jax.eval_shape(env.reset, jax.random.key(0)).pipeline_state
    num = {"carla": 0, "roach": 7, "nuplan": 2}[env.config.observation]
    assert len(jax.tree.leaves(state.past)) == num


def test_pictures_of_what_is_seen(env):
    kind = env.config.observation
    state = jax.jit(env.reset)(jax.random.key(0))
    raster = np.asarray(state.obs.raster)
    assert episode_view.policy_view(raster, SMALL, kind).size == (213, 320)
    picture = image.bev_image(raster, SMALL, 2, kind=kind)
    assert picture.shape == (48, 32, 3)
    assert (picture[36, 16] == image.EGO).all()  # 6 px from the bottom, twice as large
    assert (picture == np.array(image.ROAD)).all(axis=-1).any()


def test_the_trail_forgets_after_a_second_and_a_half(bank):
    env = make_env(bank, env_config("roach"), RewardConfig())
    state = jax.jit(env.reset)(jax.random.key(3))
    step = jax.jit(env.step)
    seen = [state.pipeline_state.agents.xy]
    trail = state.pipeline_state.past
    assert trail.xy.shape[0] == raster_roach.TRAIL_STEPS
    # Before there was anything, the first state stands for it.
    np.testing.assert_array_equal(trail.xy, np.broadcast_to(seen[0], trail.xy.shape))
    for number in range(1, 20):
        state = step(state, jnp.array([0.0, 0.5]))
        seen.append(state.pipeline_state.agents.xy)
        trail = state.pipeline_state.past
        expected = [seen[max(0, number - back)] for back in (15, 10, 5, 0)]
        np.testing.assert_array_equal(trail.xy[np.array(raster_roach.MOMENTS)], expected)
    assert np.abs(np.asarray(seen[-1]) - np.asarray(seen[0])).max() > 1.0


def test_roachs_six_numbers_and_the_eight_of_the_reproduction(bank):
    seen = {}
    for name in ("original", "carl"):
        values = env_config("roach", roach=RoachOptions(scalars=name))
        env = make_env(bank, values, RewardConfig())
        state = jax.jit(env.reset)(jax.random.key(3))
        for _ in range(3):
            state = jax.jit(env.step)(state, jnp.array([0.25, 0.75]))
        seen[name] = np.asarray(state.obs.scalars)
        np.testing.assert_array_equal(state.obs.value_scalars, np.zeros(3))
    original, carl = seen["original"], seen["carl"]
    # Throttle, steer, brake of the action; the reproduction has steer first, as `carla` has.
    np.testing.assert_allclose(original[:3], [0.75, 0.25, 0.0])
    np.testing.assert_allclose(carl[:3], [0.25, 0.75, 0.0])
    np.testing.assert_allclose(original[3:], carl[3:6])
    assert len(carl) == 8 and carl[6] == carl[4] > 0.0 and carl[7] > 5.0


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_nuplans_ten_numbers_by_hand(wrap):
    slip = math.asin(0.6)
    ego = ego_at(
        3.0, 4.0, 1.0, speed=10.0, slip=slip, accel=2.0, yaw_rate=0.5, steer=0.2, brake=0.3
    )
    past = PastMotion(steer=jnp.float32(0.1), yaw_rate=jnp.float32(0.4))
    values = wrap(observation_nuplan.scalars)(ego, past, 0.4, 0.1)
    # sin 0.6, cos 0.8. Along the motion 2 m/s^2, to its left 10 * 0.5 = 5 m/s^2: along the body
    # 2 * 0.8 - 5 * 0.6 = -1.4, left of it 2 * 0.6 + 5 * 0.8 = 5.2. Wheel 0.4 * 0.2, its rate
    # 0.4 * 0.1 / 0.1, yaw acceleration 0.1 / 0.1.
    expected = [-0.3, 0.2, 8.0, 6.0, -1.4, 5.2, 0.08, 0.4, 0.5, 1.0]
    np.testing.assert_allclose(np.asarray(values), expected, rtol=1e-5)
    assert values.shape == (observation_nuplan.NUM_SCALARS,) and values.dtype == jnp.float32


def test_nuplans_numbers_over_two_steps(bank):
    env = make_env(bank, env_config("nuplan"), RewardConfig(time_limit_s=60.0))
    state = jax.jit(env.reset)(jax.random.key(3))
    np.testing.assert_array_equal(state.obs.scalars, np.zeros(10))
    np.testing.assert_array_equal(state.obs.value_scalars, np.ones(4))
    step = jax.jit(env.step)
    for action in ([0.0, 1.0], [0.5, 1.0]):
        before, state = state, step(state, jnp.array(action))
    scalars, ego = np.asarray(state.obs.scalars), state.pipeline_state.ego
    # CARLA's saloon turns its wheels by 0.36848336 rad at full steering; 0 before.
    np.testing.assert_allclose(scalars[:2], [1.0, 0.5])
    np.testing.assert_allclose(scalars[6], 0.36848336 * 0.5, rtol=1e-5)
    np.testing.assert_allclose(scalars[7], 0.36848336 * 0.5 / 0.1, rtol=1e-5)
    turned = float(ego.yaw_rate) - float(before.pipeline_state.ego.yaw_rate)
    np.testing.assert_allclose(scalars[9], turned / 0.1, rtol=1e-5)
    assert scalars[9] > 0.1
    # Two steps of 0.1 s of 60 s are gone.
    np.testing.assert_allclose(state.obs.value_scalars[0], 1 - 0.2 / 60, rtol=1e-6)


def test_nuplans_scores_are_the_rewards_factors(bank):
    env = make_env(bank, env_config("nuplan"), RewardConfig(time_limit_s=60.0))
    sim = jax.jit(env.reset)(jax.random.key(3)).pipeline_state
    memory = sim.reward_state.replace(
        ttc_ticks=jnp.int32(9), comfort_ticks=jnp.array([1, 0, 0, 5, 0, 0], jnp.int32)
    )
    routes = env.bank.routes
    sim = sim.replace(reward_state=memory, route_idx=jnp.int32(120), step_count=jnp.int32(150))
    values = jax.jit(observation.observe)(env, sim).value_scalars
    completion = float(routes.s[sim.episode_idx, 120] / routes.length[sim.episode_idx])
    # 15 of 60 s; two of six comfort limits: 1 - 0.5 * 2 / 6; TTC 0.5.
    np.testing.assert_allclose(values, [0.75, 1 - completion, 5 / 6, 0.5], rtol=1e-6)


def test_each_kind_has_its_authors_size_unless_one_is_given():
    assert EnvConfig().raster == RasterConfig(256, 256, 2.0, 100)
    assert EnvConfig(observation="nuplan").raster == RasterConfig(256, 256, 2.0, 100)
    assert EnvConfig(observation="roach").raster == RasterConfig(192, 192, 5.0, 40)
    assert EnvConfig(observation="roach", raster=SMALL).raster == SMALL
    for kind, (channels, _, _) in SIZES.items():
        assert len(EnvConfig(observation=kind).channels) == channels


def test_the_command_line_chooses_the_kind_and_with_it_the_size():
    def parsed(*arguments):
        return train.parse(list(arguments)).config.env

    roach = parsed("carl-carla", "--env.observation", "roach", "--env.roach.scalars", "carl")
    assert roach.raster == RasterConfig(192, 192, 5.0, 40) and roach.roach.scalars == "carl"
    assert parsed(
        "carl-carla", "--env.observation", "roach", "--env.raster.height", "96"
    ).raster == (RasterConfig(96, 192, 5.0, 40))
    small = parsed("cpu", "--env.observation", "nuplan", "--env.nuplan.speed-line")
    assert small.raster == presets.CPU.env.raster and small.nuplan == NuplanOptions(speed_line=True)
    saved = config.from_json(EnvConfig, config.to_json(roach))
    assert saved == roach
    assert config.from_json(EnvConfig, {"observation": "roach"}).raster.pixels_per_metre == 5.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"raster": dataclasses.replace(SMALL, height=0)}, "env.raster.height: 0 is below"),
        ({"raster": dataclasses.replace(SMALL, width=-3)}, "env.raster.width: -3 is below"),
        ({"raster": dataclasses.replace(SMALL, pixels_per_metre=0.0)}, "pixels_per_metre: 0.0"),
        ({"raster": dataclasses.replace(SMALL, pixels_per_metre=math.nan)}, "not a number above"),
        ({"raster": dataclasses.replace(SMALL, ego_from_bottom_px=25)}, "image of 24 rows"),
        ({"raster": dataclasses.replace(SMALL, ego_from_bottom_px=-1)}, "ego_from_bottom_px: -1"),
        ({"nuplan": NuplanOptions(stop_lines=True)}, "env.nuplan: these options are of"),
        ({"roach": RoachOptions(scalars="carl")}, "env.roach: these options are of"),
    ],
)
def test_a_mistake_is_one_line(bank, changes, message):
    values = env_config("carla", **changes)
    with pytest.raises(ValueError, match="^env") as caught:
        make_env(bank, values, RewardConfig())
    assert message in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(config.ConfigError) as caught:
        dataclasses.replace(presets.CPU, env=values).validate(1)
    assert message in str(caught.value)
