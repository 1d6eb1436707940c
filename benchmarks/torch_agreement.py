"""Whether our learner and PyTorch's do the same, before `learner_torch.py` times them."""

from __future__ import annotations

from typing import Any

import jax
import learner_cases
import measure
import numpy as np
import torch
import torch_network
import torch_ppo
from learner_cases import RATE, Case

from carljax.ppo.loss import loss
from carljax.ppo.networks import ActorCritic, forward
from carljax.ppo.types import Minibatch

TOLERANCE = 1e-4
SAMPLES, MINIBATCH, MICRO = 64, 32, 16


def agree(case: Case) -> dict[str, Any]:
    """Compares both sides on a small batch, from the same parameters.

    Returns:
      `outputs_differ` and `params_differ`, the largest difference of any output (relative where it
      is above 1) and of any parameter after an update; `gradients_differ`, of any gradient relative
      to the largest of its array; `steps_differ`, of what the update added to the parameters,
      relative to all of it by the Euclidean norm. `agrees` where the first three are at most 1e-4
      and the last, in which Adam's division brings up rounding errors, at most 1e-2.
    """
    small = learner_cases.sized(case, SAMPLES, MINIBATCH, MICRO)
    given = learner_cases.arguments(small)
    found = {
        **_outputs_and_gradients_differ(small, given),
        **_updates_differ(small, given),
    }
    agrees = found["steps_differ"] <= 100 * TOLERANCE and all(
        found[name] <= TOLERANCE for name in found if name != "steps_differ"
    )
    return {**found, "agrees": agrees}


def _outputs_and_gradients_differ(case: Case, given: tuple) -> dict[str, float]:
    params, _, samples = given[:3]
    ours = ActorCritic(case.network)
    weighted = samples.replace(weight=samples.weight / case.samples)

    @measure.jit
    def both(params: Any, samples: Minibatch) -> tuple:
        gradient = jax.grad(lambda p: loss(p, ours, samples, case.ppo)[0])(params)
        return forward(ours, params, samples.obs), gradient

    outputs, gradients = both(params, weighted)
    network, given_samples = network_of(case, params), torch_ppo.samples_of(samples)
    torch_ppo.loss(network, given_samples, case.ppo, case.samples).backward()
    seen = (given_samples.raster, given_samples.scalars, given_samples.value_scalars)
    expected = [x.detach().numpy() for x in network(*seen)]
    relative = [
        np.max(np.abs(a - b) / np.maximum(np.abs(b), 1.0))
        for a, b in zip(map(np.asarray, outputs), expected, strict=True)
    ]
    worst = 0.0
    for path, parameter, turned in torch_network.pairs(network):
        assert parameter.grad is not None
        theirs = parameter.grad.numpy()
        off = np.abs(turned(torch_network.at(gradients, path)) - theirs).max()
        worst = max(worst, float(off / max(np.abs(theirs).max(), 1e-9)))
    return {"outputs_differ": float(max(relative)), "gradients_differ": worst}


def _updates_differ(case: Case, given: tuple) -> dict[str, float]:
    params, _, samples, key, _ = given
    after = learner_cases.our_update(case)(*given)[0]
    network = network_of(case, params)
    optimizer = torch_ppo.make_optimizer(network, RATE, case.ppo)
    # Shuffled as `carljax.ppo.update.update` does in its one epoch.
    shuffled = jax.random.permutation(jax.random.split(key, 1)[0], case.samples)
    rows = torch.from_numpy(np.array(shuffled, np.int64)).reshape(case.ppo.num_minibatches, -1)
    torch_ppo.update(network, optimizer, torch_ppo.samples_of(samples), rows, case.ppo, MICRO)
    worst, apart, moved = 0.0, 0.0, 0.0
    for path, parameter, turned in torch_network.pairs(network):
        ours = turned(torch_network.at(after, path))
        off = np.abs(ours - parameter.detach().numpy())
        worst = max(worst, float(off.max()))
        apart += float((off**2).sum())
        moved += float(((ours - turned(torch_network.at(params, path))) ** 2).sum())
    return {"params_differ": worst, "steps_differ": (apart / moved) ** 0.5}


def network_of(case: Case, variables: Any) -> torch_network.Network:
    """PyTorch's network with our parameters."""
    sizes = (case.image, case.num_scalars, case.num_value_scalars)
    network = torch_network.Network(case.network, *sizes)
    torch_network.load(network, variables)
    return network
