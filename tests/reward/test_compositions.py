"""Each reward on random drives against its composition in float64 NumPy (`reward_oracle`)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reward_oracle as oracle
from reward_world import (
    DT,
    VEHICLE,
    compute,
    make_agents,
    make_ego,
    make_others,
    make_situation,
    make_state,
)

from carljax.reward import reward
from carljax.reward.config import RewardConfig
from carljax.sim import bicycle

NUM_STEPS, NUM_AGENTS = 260, 5
ORACLES = {
    "carl": oracle.carl,
    "carl-nuplan": functools.partial(oracle.nuplan, mode="regular"),
    "carl-nuplan-survival": functools.partial(oracle.nuplan, mode="survival"),
    "carl-nuplan-tuned": functools.partial(oracle.nuplan, mode="tuned"),
    "roach": oracle.roach,
    "think2drive": oracle.think2drive,
}
drive_step = jax.jit(lambda ego, *controls: bicycle.step(ego, *controls, VEHICLE, DT))


def controls(rng, ego, spell):
    """Towards the road's middle with some noise; speeds and halts by spells."""
    steer = -0.05 * float(ego.xy[1]) - 0.5 * float(ego.yaw) + rng.normal() * 0.05
    if rng.random() < 0.3:
        steer = float(ego.steer)  # held still
    wanted = (11.0, 5.0, 0.0, 8.0)[spell % 4]
    pedal = np.clip(0.3 * (wanted - float(ego.speed)) + rng.normal() * 0.1, -1, 1)
    return [jnp.float32(v) for v in (np.clip(steer, -1, 1), max(pedal, 0), max(-pedal, 0))]


def bystanders(rng, ego, others):
    """Those around; at times some appear somewhere near the ego."""
    if rng.random() < 0.85:
        way = np.stack([np.cos(others["yaw"]), np.sin(others["yaw"])], axis=-1)
        return others | {"xy": others["xy"] + DT * others["speed"][:, None] * way}
    spread = rng.choice([6.0, 40.0], NUM_AGENTS)[:, None]
    return {
        "xy": np.asarray(ego.xy) + [8.0, 0.0] + rng.normal(size=(NUM_AGENTS, 2)) * spread,
        "yaw": rng.uniform(-3, 3, NUM_AGENTS),
        "speed": rng.uniform(0, 8, NUM_AGENTS),
        "yaw_rate": rng.normal(size=NUM_AGENTS) * 0.3,
        "kind": rng.integers(0, 4, NUM_AGENTS),
        "length": rng.uniform(0.5, 5, NUM_AGENTS),
        "width": rng.uniform(0.5, 2, NUM_AGENTS),
        "z": rng.choice([0.0, 0.0, 0.0, 6.0], NUM_AGENTS),
    }


def surroundings(rng, ego, agents, place):
    """A straight road to the east with lines every 40 m, and now and then something odd."""
    x, y = np.asarray(ego.xy, float)
    num = int(place // 40)
    kinds = [1, 2, 1] if num % 2 else [2, 1, 2]
    lines = 40.0 * np.array([num - 1, num, num + 1]) + 20.0
    offset = agents.xy - np.asarray(ego.xy)
    ahead = (np.abs(agents.xy[:, 1]) < 2) & (offset[:, 0] > 0)
    return make_situation(
        lane_lateral=y,
        lane_yaw=np.pi if rng.random() < 0.02 else 0.0,
        lane_in_junction=rng.random() < 0.2,
        on_parking=rng.random() < 0.05,
        off_road_frac=rng.choice([0.0, 0.97], p=[0.98, 0.02]),
        corner_off_road=rng.random(4) < 0.005,
        route_idx=int(place),
        route_s=max(x, 0.0),
        route_length=330.0,
        route_num_points=331,
        route_distance=rng.choice([abs(y), 16.0, 31.0], p=[0.96, 0.02, 0.02]),
        route_lateral=y * rng.choice([1.0, 2.5], p=[0.8, 0.2]),
        route_yaw=0.1 * np.sin(x / 10),
        speed_limit=10.0 if num % 3 else 7.0,
        stop_s=lines,
        stop_xy=np.stack([lines, np.zeros(3)], axis=-1),
        stop_kind=kinds,
        stop_light=[2, 1, 0] if rng.random() < 0.5 else [0, 2, 2],
        others=make_others(
            NUM_AGENTS,
            on_road=rng.random(NUM_AGENTS) < 0.7,
            route_gap=np.where(ahead, offset[:, 0], np.inf),
        ),
    )


def as_float64(tree):
    return jax.tree.map(lambda x: np.asarray(x, float) if x.dtype == np.float32 else x, tree)


@functools.cache
def drive(seed):
    """Egos before and after, agents and situations of a random drive, as the package sees them."""
    rng = np.random.default_rng(seed)
    ego = make_ego(speed=4.0)
    others = {"xy": np.zeros((0, 2))}
    found = []
    others = bystanders(np.random.default_rng(4), ego, others | {"yaw": 0, "speed": np.zeros(0)})
    others = others | {"xy": others["xy"] + 200.0}
    for t in range(NUM_STEPS):
        before = ego
        ego = jax.tree.map(np.asarray, drive_step(ego, *controls(rng, ego, t // 40)))
        others = bystanders(rng, ego, others)
        agents = make_agents(NUM_AGENTS, **others)
        found.append((before, ego, agents, surroundings(rng, ego, agents, float(ego.xy[0]))))
    return found


@pytest.mark.parametrize("name", ORACLES)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_random_drive_pays_what_the_formula_says(name, seed):
    config = RewardConfig(name=name, time_limit_s=20.0)
    first = drive(seed)[0]
    state = make_state(first[0], first[2], first[3], config=config, route_s=jnp.float32(0.0))
    memory = oracle.begin(0.0, 0.0)
    paid_by, happened = [], set()
    for t, (before, ego, agents, situation) in enumerate(drive(seed)):
        state = state.replace(ego=before, agents=agents, step_count=np.int32(t))
        got, _, kept, terms = compute(state, ego, agents, situation, config)
        state = state.replace(reward_state=kept)
        exact = [as_float64(part) for part in (before, ego, agents, situation)]
        want, ends, parts = ORACLES[name](memory, *exact, time_limit=20.0)
        assert {k: bool(v) for k, v in terms.terminated.items()} == ends, t
        logged = {**terms.soft, **terms.added}
        for term, value in parts.items():
            np.testing.assert_allclose(logged[term], value, rtol=1e-5, atol=2e-5, err_msg=term)
        np.testing.assert_allclose(got, want, rtol=2e-5, atol=2e-5, err_msg=f"step {t}")
        happened |= {cause for cause, value in ends.items() if value}
        paid_by.append(float(want))
    kept_apart = {"blocked"}  # takes 90 s: see the tests of each reward
    assert happened >= set(reward.REWARDS[name].causes) - kept_apart - {"lateral_distance"}
    assert len(set(np.round(paid_by, 6))) > NUM_STEPS / 4
