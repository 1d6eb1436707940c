"""Exploration hints by hand-worked rollouts, a NumPy reading of the rule, and in a train step."""

from __future__ import annotations

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_env
from flax import struct
from scipy import integrate, stats

from carljax.ppo import hints, trainer
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.ppo.hints import GO, GO_AND_TURN, NONE, STOP
from carljax.ppo.networks import ActorCritic
from carljax.reward.config import RewardConfig
from carljax.sim.env import metric_names

CAUSES = [cause for cause, _ in hints.RULES]


@pytest.mark.parametrize(
    ("ended_by", "expected"),
    [
        ([], NONE),
        (["blocked"], GO),
        (["route_deviation"], GO_AND_TURN),
        (["red_light"], STOP),
        (["stop_sign"], STOP),
        (["collision"], STOP),
        (["lateral_distance"], GO_AND_TURN),
        (["pedestrian_overlap"], STOP),
        (["blocked", "route_deviation"], GO_AND_TURN),
        (["blocked", "route_deviation", "collision"], STOP),
    ],
    ids=lambda x: "+".join(x) or "nothing" if isinstance(x, list) else "",
)
def test_what_an_end_suggests(ended_by, expected):
    metrics = {f"reward/{cause}": jnp.float32(cause in ended_by) for cause in CAUSES}
    hint = hints.of_end({**metrics, "reward/off_road": jnp.float32(1.0)})
    assert (int(hint), hint.dtype) == (expected, jnp.int8)


def test_rewards_report_the_causes_that_they_know():
    carl, roach = (set(metric_names(RewardConfig(name=name))) for name in ("carl", "roach"))
    asked = {f"reward/{cause}" for cause in CAUSES}
    assert asked <= carl | roach
    assert asked - carl == {"reward/lateral_distance", "reward/pedestrian_overlap"}
    assert asked - roach == {"reward/route_deviation"}


def test_causes_that_a_reward_does_not_know_are_left_out():
    hint = hints.of_end({"reward/collision": jnp.float32(1.0), "reward/progress": jnp.float32(0.0)})
    assert int(hint) == STOP


def _spread(ends, weight):
    return hints.spread(jnp.asarray(ends, jnp.int8), jnp.asarray(weight, jnp.float32))


def test_a_hint_reaches_its_steps_and_no_others(monkeypatch):
    """Worked by hand, with three steps instead of a hundred; one environment per column.

    First: an end by collision in row 5, restart in row 6: rows 2 to 4. Second: blocked in row 3 and
    a red light in row 7; with the restart in row 4 the three steps before that are rows 3 (an end
    itself), 5 and 6, and rows 0 to 2 are left to the first end. Third: an end in the first row has
    nothing before it.
    """
    monkeypatch.setattr(hints, "NUM_STEPS", 3)
    ends, weight = np.zeros((9, 3), int), np.ones((9, 3))
    ends[5, 0], ends[3, 1], ends[7, 1], ends[0, 2] = STOP, GO, STOP, GO_AND_TURN
    for row, column in [(6, 0), (4, 1), (8, 1), (1, 2)]:
        weight[row, column] = 0.0
    first = [NONE, NONE, STOP, STOP, STOP, NONE, NONE, NONE, NONE]
    second = [GO, GO, GO, STOP, None, STOP, STOP, NONE, None]
    actual = np.asarray(_spread(ends, weight))
    np.testing.assert_array_equal(actual[:, 0], first)
    counted = [row for row, hint in enumerate(second) if hint is not None]
    np.testing.assert_array_equal(actual[counted, 1], [second[row] for row in counted])
    np.testing.assert_array_equal(actual[:, 2], np.zeros(9))


def _one_by_one(ends, weight):
    """The rule as a recorder of experience has it: each end writes over the 100 steps before it."""
    hinted = np.full(ends.shape, NONE)
    for column in range(ends.shape[1]):
        steps = []  # rows recorded so far
        for row in range(len(ends)):
            if ends[row, column] != NONE:
                for earlier in steps[-100:]:
                    hinted[earlier, column] = ends[row, column]
            if weight[row, column] > 0:
                steps.append(row)
    return hinted


def test_hints_equal_the_numpy_reading_on_random_rollouts():
    rng = np.random.default_rng(0)
    num_steps, num_envs = 700, 12
    ends = rng.integers(GO, STOP + 1, (num_steps, num_envs))
    ends *= rng.uniform(size=ends.shape) < np.geomspace(0.002, 0.3, num_envs)
    done = (ends > 0) | (rng.uniform(size=ends.shape) < 0.01)  # some end without a hint
    weight = np.ones(ends.shape)
    for row in range(num_steps):  # the row after an end restarts and can't end
        before = done[row - 1] & (weight[row - 1] > 0) if row else np.zeros(num_envs, bool)
        weight[row] = ~before
        ends[row] *= ~before
        done[row] &= ~before
    expected = _one_by_one(ends, weight)
    actual = np.asarray(_spread(ends, weight))
    counts = weight > 0
    assert [np.mean(expected[counts] == hint) > 0.02 for hint in range(4)] == [True] * 4
    np.testing.assert_array_equal(actual[counts], expected[counts])


def _kl(p, q):
    def integrand(x):
        return stats.beta.pdf(x, *p) * (stats.beta.logpdf(x, *p) - stats.beta.logpdf(x, *q))

    return integrate.quad(integrand, 0.0, 1.0)[0]


@pytest.mark.parametrize(
    ("hint", "targets"),
    [
        (NONE, [None, None]),
        (GO, [None, (2.5, 1.0)]),
        (GO_AND_TURN, [(1.0, 1.0), (2.5, 1.0)]),
        (STOP, [None, (1.0, 1.5)]),
    ],
)
def test_divergence_is_the_mean_over_both_actions(hint, targets):
    """Steering first; integrated by SciPy."""
    policy = [(1.7, 3.1), (2.2, 1.4)]
    expected = sum(_kl(p, q) for p, q in zip(policy, targets, strict=True) if q) / 2.0
    alpha, beta_ = (jnp.float32([[pair[i] for pair in policy]]) for i in (0, 1))
    hint = jnp.array([hint], jnp.int8)
    np.testing.assert_allclose(hints.divergence(alpha, beta_, hint), [expected], atol=1e-5)
    # Only the hinted actions are drawn anywhere.
    grad = jax.grad(lambda alpha: jnp.sum(hints.divergence(alpha, beta_, hint)))(alpha)
    assert [bool(g != 0) for g in grad[0]] == [target is not None for target in targets]


def test_a_policy_that_does_what_is_hinted_at_has_no_loss():
    alpha, beta_ = jnp.float32([[5.0, 2.5], [5.0, 1.0]]), jnp.float32([[4.0, 1.0], [4.0, 1.5]])
    hint = jnp.array([GO, STOP], jnp.int8)
    np.testing.assert_allclose(hints.divergence(alpha, beta_, hint), [0.0, 0.0], atol=1e-6)


@struct.dataclass
class Cliff(toy_env.ToyEnv):
    """The toy environment, in which leaving the image is a collision."""

    def advance(self, state, action):
        """Moves the dot and names the cause of an end."""
        return self._with_causes(super().advance(state, action))

    def start(self, key):
        """Draws a position."""
        return self._with_causes(super().start(key))

    def _with_causes(self, state):
        causes = {f"reward/{cause}": jnp.zeros((), jnp.float32) for cause in CAUSES}
        causes["reward/collision"] = state.done * (1.0 - state.info["truncation"])
        return state.replace(metrics={**state.metrics, **causes})


NETWORK = ActorCritic(
    NetworkConfig(encoder="patch", hidden_size=8, joint_size=8, patch_features=(4, 8))
)
# No reward for the second action in this environment: only hints and entropy move it.
CONFIG = PPOConfig(
    total_samples=1_000_000,
    num_envs=8,
    num_steps=32,
    num_minibatches=1,
    update_epochs=4,
    learning_rate=3e-3,
    anneal_lr=False,
    ent_coef=0.0,
    hint_coef=1.0,
)


def _train(config, num_devices, num=6):
    mesh = trainer.make_mesh(num_devices)
    env = trainer.replicate(Cliff(starts=toy_env.make().starts), mesh)
    state = trainer.init(jax.random.key(0), env, NETWORK, config, mesh)
    chex.clear_trace_counter()  # it counts by the function's name
    with pytest.MonkeyPatch.context() as patch:
        traced = chex.assert_max_traces(trainer._local_step, n=1)
        patch.setattr(trainer, "_local_step", traced)
        train_step = trainer.make_train_step(NETWORK, config, mesh)
    history = []
    for _ in range(num):
        state, metrics = train_step(env, state)
        history.append(jax.tree.map(float, metrics))
    return jax.device_get(state.params), history


def test_hints_to_stop_are_followed_on_one_device_and_on_four():
    """KL to Beta(1, 1.5) falls below that of the flat Beta(1, 1) that a new network is near."""
    (one, history), (four, on_four) = (_train(CONFIG, num) for num in (1, 4))
    losses = [metrics["ppo/hint_loss"] for metrics in history]
    assert losses[-1] < 0.5 * losses[0]
    np.testing.assert_allclose(
        losses, [metrics["ppo/hint_loss"] for metrics in on_four], rtol=2e-2, atol=1e-4
    )
    gaps = jax.tree.map(lambda a, b: np.max(np.abs(a - b)), one, four)
    assert max(jax.tree.leaves(gaps)) < 2e-3


def test_without_the_coefficient_there_is_no_trace_of_hints():
    _, history = _train(dataclasses.replace(CONFIG, hint_coef=0.0), 1, num=1)
    assert "ppo/hint_loss" not in history[0]


def test_a_negative_coefficient_is_refused():
    with pytest.raises(ValueError, match=r"ppo\.hint_coef must be at least 0, not -0\.1"):
        dataclasses.replace(CONFIG, hint_coef=-0.1).validate()
