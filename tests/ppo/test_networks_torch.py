"""The three networks of the paper against PyTorch ones built here, layer by layer, same weights."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.ppo.config import NetworkConfig
from carljax.ppo.networks import ActorCritic, ConvEncoder, Linear
from carljax.sim.types import Observation

torch = pytest.importorskip("torch", reason="PyTorch is an extra: pip install -e '.[test-torch]'")
nn = torch.nn

# Channels, kernel, stride, side of the output. source: the authors' code, roach and roach_ln2.
ROACH = [(8, 5, 2, 94), (16, 5, 2, 45), (32, 5, 2, 21), (64, 3, 2, 10), (128, 3, 2, 4)]
ROACH += [(256, 3, 1, 2)]
CARL = [(8, 5, 2, 126), (16, 5, 2, 61), (24, 5, 2, 29), (32, 5, 2, 13), (64, 3, 2, 6)]
CARL += [(128, 3, 1, 4), (256, 3, 1, 2)]
# Our configuration; then for PyTorch: convolutions, image (C, H, W), scalars, value scalars.
NETWORKS = {
    "carl-carla": (NetworkConfig(), CARL, (10, 256, 256), 8, 10),
    "carl-nuplan": (NetworkConfig(conv_init="torch"), CARL, (9, 256, 256), 10, 4),
    "roach": (
        NetworkConfig(encoder="roach", layer_norm=False, beta_min=0.0),
        ROACH,
        (15, 192, 192),
        6,
        0,
    ),
}


class TorchNetwork(nn.Module):
    """The authors' network as their documents describe it."""

    def __init__(self, layers, image, num_scalars, num_value_scalars, norm, beta_min):
        super().__init__()
        self.beta_min = beta_min
        convs, channels = [], image[0]
        for features, kernel, stride, side in layers:
            convs.append(nn.Conv2d(channels, features, kernel, stride))
            convs += [nn.LayerNorm((features, side, side))] if norm else []
            convs.append(nn.ReLU())
            channels = features
        self.encoder = nn.Sequential(*convs, nn.Flatten())

        def mlp(*sizes):
            parts = []
            for num_in, num_out in zip(sizes, sizes[1:], strict=False):
                parts.append(nn.Linear(num_in, num_out))
                parts += [nn.LayerNorm(num_out)] if norm else []
                parts.append(nn.ReLU())
            return nn.Sequential(*parts)

        self.scalar_mlp = mlp(num_scalars, 256, 256)
        self.joint_mlp = mlp(1024 + 256, 512, 256)
        self.policy_mlp = mlp(256, 256, 256)
        self.value_mlp = mlp(256 + num_value_scalars, 256, 256)
        self.alpha, self.beta, self.value = nn.Linear(256, 2), nn.Linear(256, 2), nn.Linear(256, 1)

    def forward(self, image, scalars, value_scalars):  # noqa: D102
        image = self.encoder(image.float() / 255.0)
        features = self.joint_mlp(torch.cat([image, self.scalar_mlp(scalars)], 1))
        policy = self.policy_mlp(features)
        softplus = nn.functional.softplus
        value = self.value(self.value_mlp(torch.cat([features, value_scalars], 1)))
        alpha = softplus(self.alpha(policy)) + self.beta_min
        return alpha, softplus(self.beta(policy)) + self.beta_min, value[:, 0]


def _obs(image, num_scalars, num_value_scalars, num=2):
    rng = np.random.default_rng(1)
    channels, height, width = image
    return Observation(
        raster=rng.integers(0, 256, (num, height, width, channels), np.uint8),
        scalars=rng.normal(size=(num, num_scalars)).astype(np.float32),
        value_scalars=rng.normal(size=(num, num_value_scalars)).astype(np.float32),
    )


def _params(network, obs):
    """Weights that keep the size of the signal; scales near 1, biases near 0, none of them so."""
    rng = np.random.default_rng(2)

    def fill(path, x):
        name = path[-1].key
        if name == "scale":
            return (1.0 + 0.3 * rng.normal(size=x.shape)).astype(np.float32)
        if "bias" in name:
            return (0.3 * rng.normal(size=x.shape)).astype(np.float32)
        fan_in = np.prod(x.shape[:-1])
        return (rng.normal(size=x.shape) * np.sqrt(2.0 / fan_in)).astype(np.float32)

    shapes = jax.eval_shape(network.init, jax.random.key(0), obs)
    return jax.tree_util.tree_map_with_path(fill, shapes)


def _copy(target, array):
    assert tuple(target.shape) == array.shape
    target.data = torch.from_numpy(np.ascontiguousarray(array))


def _copy_convs(sequence, params):
    convs = [part for part in sequence if isinstance(part, nn.Conv2d)]
    for i, conv in enumerate(convs):
        _copy(conv.weight, params[f"kernel_{i}"].transpose(3, 2, 0, 1))  # HWIO -> OIHW
        _copy(conv.bias, params[f"bias_{i}"])
    for i, norm in enumerate(part for part in sequence if isinstance(part, nn.LayerNorm)):
        _copy(norm.weight, params[f"LayerNorm_{i}"]["scale"].transpose(2, 0, 1))  # HWC -> CHW
        _copy(norm.bias, params[f"LayerNorm_{i}"]["bias"].transpose(2, 0, 1))


def _copy_linear(linear, params):
    _copy(linear.weight, params["kernel"].T)
    _copy(linear.bias, params["bias"])


def _copy_mlp(sequence, params):
    linears = [part for part in sequence if isinstance(part, nn.Linear)]
    for i, linear in enumerate(linears):
        _copy_linear(linear, params[f"Linear_{i}"])
    for i, norm in enumerate(part for part in sequence if isinstance(part, nn.LayerNorm)):
        _copy(norm.weight, params[f"LayerNorm_{i}"]["scale"])
        _copy(norm.bias, params[f"LayerNorm_{i}"]["bias"])


def _channels_first(kernel):
    """Orders the rows of the joint layer's first 1,024 inputs, (2, 2, 256), as (256, 2, 2)."""
    image = kernel[:1024].reshape(2, 2, 256, -1).transpose(2, 0, 1, 3).reshape(1024, -1)
    return np.concatenate([image, kernel[1024:]])


def _torch_network(name, params):
    config, *sizes = NETWORKS[name]
    network = TorchNetwork(*sizes, config.layer_norm, config.beta_min)
    joint = dict(params["joint_mlp"])
    joint["Linear_0"] = {
        "kernel": _channels_first(joint["Linear_0"]["kernel"]),
        "bias": joint["Linear_0"]["bias"],
    }
    _copy_convs(network.encoder, params["encoder"])
    _copy_mlp(network.joint_mlp, joint)
    for part in ("scalar_mlp", "policy_mlp", "value_mlp"):
        _copy_mlp(getattr(network, part), params[part])
    for part in ("alpha", "beta", "value"):
        _copy_linear(getattr(network, part), params[part])
    return network


@pytest.mark.parametrize("name", NETWORKS)
def test_outputs_are_those_of_the_pytorch_network(name):
    config, _, *sizes = NETWORKS[name]
    network, obs = ActorCritic(config), _obs(*sizes)
    variables = _params(network, obs)
    reference = _torch_network(name, variables["params"])
    num_params = sum(p.numel() for p in reference.parameters())
    assert num_params == sum(x.size for x in jax.tree.leaves(variables))
    with torch.no_grad():
        expected = reference(
            torch.from_numpy(obs.raster.transpose(0, 3, 1, 2).copy()),
            torch.from_numpy(obs.scalars),
            torch.from_numpy(obs.value_scalars),
        )
    actual = jax.jit(network.apply)(variables, jax.tree.map(jnp.asarray, obs))
    for ours, theirs in zip(actual, expected, strict=True):
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-4, atol=1e-4)
    assert np.ptp(np.concatenate([np.ravel(x) for x in expected])) > 0.5  # not all the same


@pytest.mark.parametrize("kind", ["xavier", "torch"])
def test_first_values_of_a_convolution_are_pytorchs(kind):
    """Both are uniform: the largest of 51,200 values is within 0.1 % of the bound."""
    torch.manual_seed(0)
    layer = nn.Conv2d(24, 128, 5)  # shaped like no layer of the encoder, to keep fans apart
    if kind == "xavier":
        nn.init.xavier_uniform_(layer.weight, gain=nn.init.calculate_gain("relu"))
        nn.init.constant_(layer.bias, 0.1)
    encoder = ConvEncoder(NetworkConfig(encoder="roach", layer_norm=False, conv_init=kind))
    params = jax.jit(encoder.init)(jax.random.key(0), jnp.zeros((1, 16, 16, 3), jnp.uint8))
    for i, (num_in, num_out, size) in enumerate([(3, 8, 5), (8, 16, 5), (16, 32, 5), (32, 64, 3)]):
        ours = params["params"][f"kernel_{i}"]
        fans, their_fans = (size**2 * num_in, size**2 * num_out), (25 * 24, 25 * 128)
        bound = [f[0] if kind == "torch" else sum(f) for f in (fans, their_fans)]
        largest = np.sqrt(bound[0] / bound[1]) * np.max(np.abs(ours))
        assert largest == pytest.approx(layer.weight.abs().max().item(), rel=0.02)
    bias = params["params"]["bias_5"]  # of 256 values, from 9 x 128 inputs
    if kind == "xavier":
        np.testing.assert_array_equal(bias, np.full(256, layer.bias[0].item(), np.float32))
    else:
        largest = np.sqrt(9 * 128 / (25 * 24)) * np.max(np.abs(bias))
        assert largest == pytest.approx(layer.bias.abs().max().item(), rel=0.05)


def test_first_values_of_a_linear_layer_are_pytorchs():
    ours = Linear(256).init(jax.random.key(0), jnp.zeros((1, 512), jnp.float32))["params"]
    torch.manual_seed(0)
    theirs = nn.Linear(512, 256)
    pairs = [(ours["kernel"], theirs.weight), (ours["bias"], theirs.bias)]
    for left, right in pairs:
        assert np.std(left) == pytest.approx(right.std().item(), rel=0.15)
        assert np.max(np.abs(left)) == pytest.approx(right.abs().max().item(), rel=0.05)
