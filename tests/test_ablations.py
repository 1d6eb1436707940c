"""The paper's tables as data: every cell of every table is a configuration that can be trained."""

import typing

import pytest

from carljax import ablations, presets
from carljax.ablations import ABLATIONS, Cell, Times
from carljax.config import ConfigError
from carljax.experiments import Command

CPU = presets.PRESETS["cpu"].config


def configs(name, base=CPU, samples=10_000_000):
    return [ablations.configure(cell, base, samples) for cell in ABLATIONS[name].cells]


@pytest.mark.parametrize("preset", ["cpu", "carl-carla", "atari"])
@pytest.mark.parametrize("name", ABLATIONS)
def test_every_cell_can_be_trained(name, preset):
    base = presets.PRESETS[ABLATIONS[name].preset or preset].config
    made = configs(name, base)
    for config in made:
        config.validate(1)
    assert len({repr(config) for config in made}) == len(made)
    rest = [config for config in made if config == base]
    assert len(rest) <= 1


def test_the_command_knows_every_table():
    hint = typing.get_type_hints(Command, include_extras=True)["name"]
    assert typing.get_args(typing.get_args(hint)[0]) == tuple(ABLATIONS)


@pytest.mark.parametrize("preset", ["cpu", "atari", "carl-carla"])
def test_minibatches_are_the_papers_with_the_same_steps_an_epoch(preset):
    base = presets.PRESETS[preset].config
    made = configs("reward-minibatch", base)
    assert [c.reward.name for c in made] == ["roach", "roach", "carl", "carl"]
    assert [c.ppo.minibatch_size for c in made] == [256, 1024, 256, 1024]
    assert {c.ppo.num_minibatches for c in made} == {base.ppo.num_minibatches}
    assert {c.ppo.num_envs for c in made} == {base.ppo.num_envs}
    assert {c.ppo.total_samples for c in made} == {10_000_000}


def test_tables_change_what_they_say():
    small, large = configs("scale")
    assert (small.ppo.total_samples, large.ppo.total_samples) == (333_333, 10_000_000)
    assert 16 * small.ppo.minibatch_size == large.ppo.minibatch_size
    assert [c.ppo.update_epochs for c in configs("epochs")] == [4, 3]
    shown = [(c.network.layer_norm, c.network.asymmetric_critic) for c in configs("architecture")]
    assert shown == [(False, False), (True, False), (True, True)]
    assert [c.network.beta_min for c in configs("action-distribution")] == [0.0, 1.0]
    roach, carl = configs("input")
    assert roach.env.raster.shape[:2] == (192, 192) and roach.env.observation == "roach"
    assert carl.env.raster.shape == (256, 256, 10) and carl.network.encoder == "carl"
    sets = configs("hyperparameters")
    assert [(c.ppo.num_envs, c.ppo.num_steps, c.ppo.kl_patience) for c in sets] == [
        (6, 2048, 8),
        (8, 128, None),
    ]


def test_a_minibatch_that_cannot_be_reached_is_refused():
    with pytest.raises(ConfigError, match="odd: 32 minibatches of 99 samples"):
        ablations.configure(Cell("odd", minibatch=99), CPU, 1000)


def test_values_are_multiplied_and_whole_numbers_stay_whole():
    config = ablations.changed(CPU, ["ppo", "num_envs"], Times(1 / 16))
    assert config.ppo.num_envs == 8 and type(config.ppo.num_envs) is int
    assert ablations.changed(CPU, ["ppo", "gamma"], Times(0.5)).ppo.gamma == 0.4985
    with pytest.raises(AttributeError, match="gama"):
        ablations.changed(CPU, ["ppo", "gama"], 1.0)
