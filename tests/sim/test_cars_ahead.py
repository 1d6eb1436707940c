"""Cars ahead on a plan: of many the next few on each lane, against all pairs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_world import EGO_LENGTH, SLOTS, cars, ego_place, f32, make_ego

from carljax.sim import cars_ahead, lights, order, priority, right_of_way


def traffic(world, num, seed):
    """Cars on the lanes of one crossing, many of which stand."""
    rng = np.random.default_rng(seed)
    arms, ways = ("east", "north", "west", "south"), ("straight", "left", "right")
    made = []
    for _ in range(num):
        plan = world.way("plain", str(rng.choice(arms)), str(rng.choice(ways)))
        first = rng.integers(0, 3)
        lanes = (*plan[first:], -1, -1)[:3]
        s = rng.uniform(0.0, float(world.map.lane_length[lanes[0]]))
        speed = float(rng.choice([0.0, rng.uniform(0.0, 9.0)]))
        made.append({"lanes": lanes, "lane_s": s, "speed": speed, "length": rng.uniform(3.5, 9.0)})
    eights = [cars(world, *made[k : k + SLOTS]) for k in range(0, num, SLOTS)]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *eights)


def seen(agents, road_map):
    clock = lights.clock(f32(0.0), 0)
    stop = right_of_way.stop_ahead(agents, road_map, clock)
    movers = right_of_way.all_movers(
        agents, stop, make_ego(), f32(EGO_LENGTH), ego_place(), road_map, clock
    )
    along = cars_ahead.look(agents, movers, road_map)
    half = 0.5 * agents.length
    focus = priority.focus_of(agents, road_map, jnp.full_like(half, 10.0))
    to_queue = jnp.where(along.is_queued, along.gap, 1e3).min(axis=0)
    gap, speed = cars_ahead.leaders(along.gap, along.speed)
    speed = jnp.where(gap < 500.0, speed, -1.0)  # of nobody
    return along.gap.shape[0], (gap, speed, to_queue, priority.has_room(focus, half, along))


@pytest.mark.parametrize("seed", range(3))
def test_of_many_the_next_on_each_lane_are_enough(world, monkeypatch, seed):
    agents = traffic(world, 32, seed)
    rows, want = seen(agents, world.map)
    assert rows == agents.speed.shape[0] + 1
    monkeypatch.setattr(order, "MANY", 4)
    rows, got = seen(agents, world.map)
    assert rows == 3 * cars_ahead.NEXT
    names = ("gap", "speed", "gap to the queue", "room")
    for name, a, b in zip(names, want, got, strict=True):
        np.testing.assert_allclose(b, a, atol=1e-4, err_msg=name)
        assert len(set(np.asarray(a).tolist())) > 1, name  # not all the same
