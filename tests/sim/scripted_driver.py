"""A simple driver for tests: follows its route at 5 m/s, and whole episodes under its hands."""

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim import route, situation
from carljax.sim.types import LIGHT_GREEN, STOP_LIGHT, STOP_SIGN

LOOK_AHEAD = 4  # route points
CHUNK = 50  # steps
FULL_THROTTLE, STAND, FOLLOW, FOLLOW_BLINDLY = range(4)


def steering(env, ego, target):
    """Pure pursuit: the arc through a point ahead, by the bicycle's own geometry."""
    offset = target - ego.xy
    cos, sin = jnp.cos(ego.yaw), jnp.sin(ego.yaw)
    left = cos * offset[1] - sin * offset[0]
    curvature = 2.0 * left / jnp.maximum((offset**2).sum(), 1.0)
    car = env.vehicle
    slip = jnp.arcsin(jnp.clip(car.rear_length * curvature, -0.9, 0.9))
    wheelbase = car.rear_length + car.front_length
    wheel = jnp.arctan(jnp.tan(slip) * wheelbase / car.rear_length)
    return jnp.clip(wheel / car.wheel_angle_max, -1.0, 1.0)


def pedal(env, speed, wanted):
    """Throttle (positive) or brake that changes the speed by what is missing, per second."""
    car = env.vehicle
    accel = jnp.clip(1.5 * (wanted - speed), -6.0, 2.0)
    full = car.accel_max * jnp.exp(-speed / car.accel_speed)
    throttle = (jnp.maximum(accel, 0.0) / full) ** (1.0 / car.throttle_exponent)
    return jnp.where(accel > 0, throttle, accel / car.brake_max)


def follow(env, sim, obeys, speed):
    """Steers along the route; stops for lights that are not green and for stop signs."""
    stretch, first = route.window(env.bank.routes, sim.episode_idx, sim.route_idx)
    idx = sim.route_idx - first
    ego = sim.ego
    target = stretch.xy[jnp.minimum(idx + LOOK_AHEAD, stretch.num_points - 1)]
    lights = situation.stop_lights(env.bank.road_map, stretch, sim.lights)
    closed = (stretch.stop_kind == STOP_LIGHT) & (lights != LIGHT_GREEN)
    closed |= (stretch.stop_kind == STOP_SIGN) & ~sim.reward_state.stop_satisfied
    bumper = stretch.s[idx] + 0.5 + 0.5 * env.vehicle.length
    gap = stretch.stop_s - bumper
    needed = ego.speed**2 / (2 * 4.0)
    ahead = closed & (gap > -0.5) & (gap > needed - 2.0)
    room = jnp.where(ahead & obeys, gap - 1.0, 1e3).min()
    wanted = jnp.minimum(speed, jnp.sqrt(2 * 2.0 * jnp.maximum(room, 0.0)))
    wanted = jnp.where(room < 0.3, -10.0, wanted)
    return jnp.stack([steering(env, ego, target), pedal(env, ego.speed, wanted)])


def act(env, sim, script, speed):
    """The action of a script, one of the constants above."""
    route_action = follow(env, sim, script != FOLLOW_BLINDLY, speed)
    fixed = jnp.stack([jnp.zeros_like(speed), jnp.where(script == STAND, -1.0, 1.0)])
    return jnp.where(script >= FOLLOW, route_action, fixed)


@jax.jit
def drive_on(env, states, script, speed):
    """The next `CHUNK` states of each episode; after its end its last state repeats."""

    def one(state):
        def step(state, _):
            action = act(env, state.pipeline_state, script, speed)
            after = env.advance(state, action)
            kept = jax.tree.map(lambda a, b: jnp.where(state.done > 0, a, b), state, after)
            return kept, kept

        return jax.lax.scan(step, state, None, length=CHUNK)

    return jax.vmap(one)(states)


def fetch(state):
    """A state as NumPy, without image and key (NumPy holds no keys)."""
    sim = state.pipeline_state.replace(key=None)
    return jax.tree.map(np.asarray, state.replace(pipeline_state=sim, obs=None))


start = jax.jit(
    jax.vmap(lambda env, episode, key: env.start_episode(episode, key), in_axes=(None, 0, 0))
)


def episodes(env, episodes, keys, script, speed, num_steps=1300):
    """Episodes on given episodes until all have ended: States without images, (B, T, ...)."""
    states = start(env, episodes, keys)
    chunks = []
    while len(chunks) * CHUNK < num_steps and not (states.done > 0).all():
        states, chunk = drive_on(env, states, script, speed)
        chunks.append(fetch(chunk))
    return jax.tree.map(lambda *x: np.concatenate(x, axis=1), *chunks)
