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

LIMITS = {
    "outputs_differ": 1e-4,
    "params_differ": 1e-4,
    "gradients_differ": 1e-4,
    "gradients_differ_float32": 2e-3,
    "steps_differ": 1e-2,  # Adam's division brings up rounding errors
}
SAMPLES, MINIBATCH, MICRO = 64, 32, 16
PARTS = 8  # of the samples; each has a gradient of its own


def agree(case: Case) -> dict[str, Any]:
    """Compares both sides on a small batch, from the same parameters.

    Returns:
      `outputs_differ` and `params_differ`, the largest difference of any output (relative where it
      is above 1) and of any parameter after an update; `gradients_differ`, of any of our gradients
      from PyTorch's in float64, relative to the largest of its array, for the middle one of eight
      parts of the batch: an input of a ReLU that is all but zero may be rounded to either side of
      it, which changes the gradient of its part; `gradients_differ_float32`, the same from
      PyTorch's in float32, whose convolutions on a CPU add up less exactly than ours;
      `steps_differ`, of what the update added to the parameters, relative to all of it by the
      Euclidean norm. `agrees` where each is within its limit of `LIMITS`.
    """
    small = learner_cases.sized(case, SAMPLES, MINIBATCH, MICRO)
    given = learner_cases.arguments(small)
    found = {
        **_outputs_and_gradients_differ(small, given),
        **_updates_differ(small, given),
    }
    return {**found, "agrees": all(found[name] <= limit for name, limit in LIMITS.items())}


def _outputs_and_gradients_differ(case: Case, given: tuple) -> dict[str, float]:
    params, _, samples = given[:3]
    ours = ActorCritic(case.network)
    weighted = samples.replace(weight=samples.weight / case.samples)
    gradient = measure.jit(lambda p, part: jax.grad(lambda p: loss(p, ours, part, case.ppo)[0])(p))
    outputs = measure.jit(lambda p, obs: forward(ours, p, obs))(params, samples.obs)
    network, given_samples = network_of(case, params), torch_ppo.samples_of(samples)
    seen = (given_samples.raster, given_samples.scalars, given_samples.value_scalars)
    expected = [x.detach().numpy() for x in network(*seen)]
    relative = [
        np.max(np.abs(a - b) / np.maximum(np.abs(b), 1.0))
        for a, b in zip(map(np.asarray, outputs), expected, strict=True)
    ]
    exact, off, off_float32 = network_of(case, params).double(), [], []
    for rows in np.arange(case.samples).reshape(PARTS, -1):
        found = gradient(params, jax.tree.map(lambda x, rows=rows: x[rows], weighted))
        part = torch_ppo.samples_of(jax.tree.map(lambda x, rows=rows: x[rows], samples))
        off.append(_gradients_differ(case, found, exact, part.double()))
        off_float32.append(_gradients_differ(case, found, network, part))
    return {
        "outputs_differ": float(max(relative)),
        "gradients_differ": float(np.median(off)),
        "gradients_differ_float32": float(np.median(off_float32)),
    }


def _gradients_differ(
    case: Case, ours: Any, network: torch_network.Network, samples: torch_ppo.Samples
) -> float:
    network.zero_grad()
    torch_ppo.loss(network, samples, case.ppo, case.samples).backward()
    worst = 0.0
    for path, parameter, turned in torch_network.pairs(network):
        assert parameter.grad is not None
        theirs = parameter.grad.numpy()
        off = np.abs(turned(torch_network.at(ours, path)) - theirs).max()
        worst = max(worst, float(off / max(np.abs(theirs).max(), 1e-9)))
    return worst


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
