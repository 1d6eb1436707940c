"""The actor-critic: the paper's size and initialisation, any input size, who sees what."""

from __future__ import annotations

import re

import fill
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.ppo.config import NetworkConfig
from carljax.ppo.networks import CONV_LAYERS, ActorCritic, ConvEncoder, Linear, conv_fit
from carljax.sim.types import Observation


def _obs(num, size, channels=10, scalars=8, value_scalars=10):
    rng = np.random.default_rng(0)
    return Observation(
        raster=jnp.asarray(rng.integers(0, 256, (num, size, size, channels)), jnp.uint8),
        scalars=jnp.asarray(rng.normal(size=(num, scalars)), jnp.float32),
        value_scalars=jnp.asarray(rng.normal(size=(num, value_scalars)), jnp.float32),
    )


def _num_params(network, obs):
    shapes = jax.eval_shape(network.init, jax.random.key(0), obs)
    return sum(x.size for x in jax.tree.leaves(shapes))


@pytest.mark.parametrize(
    ("config", "obs", "expected"),
    [
        # conv 421,600 + their LayerNorm 435,024 + scalars 69,120 + joint 788,736 + policy 133,636
        # + value 135,425. source: CaRL paper's network, counted layer by layer.
        (NetworkConfig(), dict(size=256), 1_983_541),
        # nuPlan: 9 channels, 10 scalars, 4 value scalars: 200 weights of the first convolution and
        # 6 x 256 of the critic less, 2 x 256 of the scalar branch more than 1,983,541.
        (NetworkConfig(), dict(size=256, channels=9, scalars=10, value_scalars=4), 1_982_317),
        # Roach without LayerNorm: 15 channels, 6 scalars, no critic inputs.
        (
            NetworkConfig(encoder="roach", layer_norm=False),
            dict(size=192, channels=15, scalars=6, value_scalars=0),
            1_525_813,
        ),
    ],
    ids=["carl-carla", "carl-nuplan", "roach"],
)
def test_parameter_count_is_the_papers(config, obs, expected):
    assert _num_params(ActorCritic(config), _obs(1, **obs)) == expected


@pytest.mark.parametrize(
    ("encoder", "size"), [("carl", 7), ("carl", 64), ("roach", 20), ("patch", 20)]
)
def test_any_image_size_works(encoder, size):
    network = ActorCritic(NetworkConfig(encoder=encoder))
    obs = _obs(3, size)
    alpha, beta, value = jax.jit(network.apply)(fill.params(network, obs), obs)
    assert alpha.shape == beta.shape == (3, 2)
    assert value.shape == (3,)
    assert np.all(np.asarray(alpha) > 1.0)
    assert np.all(np.asarray(beta) > 1.0)
    assert np.all(np.isfinite(value))


def _last_size(encoder, size):
    for _, kernel, stride in CONV_LAYERS[encoder]:
        (padding, _), stride = conv_fit((size, size), kernel, stride)
        size = (size + sum(padding) - kernel) // stride + 1
    return size


def test_small_images_keep_four_cells():
    """The rule of ConvEncoder, worked by hand for the seven layers at 64 px.

    64 -5/2-> 30 -5/2-> 13 -5/2-> 5; valid would leave 1, so SAME/2: 3; 3/2 SAME: 2; 2; 2.
    """
    assert conv_fit((64, 64), 5, 2) == ([(0, 0), (0, 0)], 2)
    # Size 5, kernel 5, stride 2: 3 outputs span (3 - 1) * 2 + 5 = 9, that is 4 more than 5.
    assert conv_fit((5, 5), 5, 2) == ([(2, 2), (2, 2)], 2)
    # Size 2, stride 2 would leave one output even padded: stride 1, 2 + 2 = 1 + 3.
    assert conv_fit((2, 2), 3, 2) == ([(1, 1), (1, 1)], 1)
    assert [_last_size("carl", size) for size in (32, 64, 96, 128, 256)] == [2] * 5
    assert [_last_size("roach", size) for size in (64, 192)] == [2, 2]


def test_initialisation_is_the_papers():
    encoder = ConvEncoder(NetworkConfig(encoder="roach", layer_norm=False))
    params = jax.jit(encoder.init)(jax.random.key(0), _obs(1, 16).raster)["params"]
    np.testing.assert_array_equal(params["bias_3"], np.full(64, 0.1, np.float32))
    # Xavier uniform, gain sqrt(2): bound sqrt(2) sqrt(6 / (fan_in + fan_out)); 9 taps, 32 -> 64.
    bound = np.sqrt(2.0 * 6.0 / (9 * 32 + 9 * 64))
    largest = np.max(np.abs(params["kernel_3"]))
    assert 0.99 * bound < largest <= bound
    # As nuPlan's, both within 1 / sqrt(9 x 32).
    encoder = ConvEncoder(NetworkConfig(encoder="roach", layer_norm=False, conv_init="torch"))
    params = jax.jit(encoder.init)(jax.random.key(0), _obs(1, 16).raster)["params"]
    for name in ("kernel_3", "bias_3"):
        largest = np.max(np.abs(params[name]))
        assert 0.9 * 288**-0.5 < largest <= 288**-0.5
    # PyTorch's linear layer: both within 1 / sqrt(256).
    layer = Linear(128).init(jax.random.key(0), jnp.zeros((1, 256), jnp.float32))["params"]
    for name in ("kernel", "bias"):
        assert 0.9 / 16.0 < np.max(np.abs(layer[name])) <= 1.0 / 16.0


@pytest.mark.parametrize("encoder", ["carl", "patch"])
def test_encoder_equals_a_numpy_one(encoder):
    """Float64 loops over windows: convolution, LayerNorm over the layer's axes, ReLU."""
    config = NetworkConfig(encoder=encoder, patch_size=4, patch_features=(3, 5))
    network = ActorCritic(config)
    obs = _obs(2, 20, channels=2)
    variables = fill.params(network, obs)
    _, state = network.apply(variables, obs, capture_intermediates=True)
    actual = state["intermediates"]["encoder"]["__call__"][0]
    params = jax.tree.map(np.float64, variables["params"]["encoder"])
    x = np.float64(obs.raster) / 255.0
    if encoder == "patch":
        layers, axes = [(4, 4), (2, 2)], (-1,)
    else:
        layers, axes = [(5, 2), (5, 2), (5, 2), (5, 2), (3, 2), (3, 1), (3, 1)], (-3, -2, -1)
    for i, (kernel, stride) in enumerate(layers):
        if encoder == "patch":
            pad = [(0, -x.shape[1] % kernel)] * 2
        else:
            pad, stride = conv_fit(x.shape[1:3], kernel, stride)
        x = np.pad(x, ((0, 0), *pad, (0, 0)))
        size = (x.shape[1] - kernel) // stride + 1
        weight = params[f"kernel_{i}"]
        out = np.zeros((2, size, size, weight.shape[-1]))
        for row in range(size):
            for col in range(size):
                r, c = row * stride, col * stride
                window = x[:, r : r + kernel, c : c + kernel]
                out[:, row, col] = np.tensordot(window, weight, 3) + params[f"bias_{i}"]
        centred = out - out.mean(axes, keepdims=True)
        out = centred / np.sqrt((centred**2).mean(axes, keepdims=True) + 1e-5)
        norm = params[f"LayerNorm_{i}"]
        x = np.maximum(out * norm["scale"] + norm["bias"], 0.0)
    np.testing.assert_allclose(actual, x.reshape(2, -1), atol=2e-4)


def test_only_the_critic_sees_the_value_scalars():
    network = ActorCritic(NetworkConfig(encoder="patch"))
    obs = _obs(2, 16)
    params = fill.params(network, obs)
    other = obs.replace(value_scalars=obs.value_scalars + 1.0)
    alpha, beta, value = network.apply(params, obs)
    alpha_2, beta_2, value_2 = network.apply(params, other)
    np.testing.assert_array_equal(alpha, alpha_2)
    np.testing.assert_array_equal(beta, beta_2)
    assert np.all(np.abs(value - value_2) > 1e-4)
    alpha_3, _, _ = network.apply(params, obs.replace(scalars=obs.scalars + 1.0))
    assert np.all(np.abs(alpha - alpha_3) > 1e-6)


def test_beta_min_bounds_alpha_and_beta():
    obs = _obs(2, 16)
    outputs = []
    for beta_min in (0.0, 1.0):
        network = ActorCritic(NetworkConfig(encoder="patch", beta_min=beta_min))
        outputs.append(network.apply(fill.params(network, obs), obs))
    for lower, higher in zip(outputs[0][:2], outputs[1][:2], strict=True):
        np.testing.assert_allclose(higher - lower, 1.0, atol=1e-6)


@pytest.mark.parametrize("encoder", ["carl", "roach", "patch"])
def test_bfloat16_products_say_what_float32_ones_do(encoder):
    """Outputs and gradients of float32 parameters, as near as eight bits of mantissa allow."""
    obs = _obs(8, 64)
    plain = ActorCritic(NetworkConfig(encoder=encoder))
    params = jax.tree.map(lambda x: x + 0.01, plain.init(jax.random.key(0), obs))

    def loss(params, network):
        alpha, beta, value = network.apply(params, obs)
        return jnp.mean(jnp.log(alpha) * value[:, None] + beta), (alpha, beta, value)

    def of(dtype):
        network = ActorCritic(NetworkConfig(encoder=encoder, compute_dtype=dtype))
        return jax.jit(jax.value_and_grad(loss, has_aux=True), static_argnums=1)(params, network)

    ((_, exact), exact_gradient), ((_, near), gradient) = of("float32"), of("bfloat16")
    for one, other in zip(exact, near, strict=True):
        assert other.dtype == jnp.float32
        assert 0.0 < np.abs(other - one).max() < 0.05 * np.abs(one).max()
    for (path, one), other in zip(
        jax.tree_util.tree_leaves_with_path(exact_gradient), jax.tree.leaves(gradient), strict=True
    ):
        assert other.dtype == jnp.float32
        cosine = jnp.vdot(one, other) / (jnp.linalg.norm(one) * jnp.linalg.norm(other))
        # Least for biases before a LayerNorm, whose gradients are sums of opposite numbers.
        assert cosine > 0.9, (jax.tree_util.keystr(path), cosine)


@pytest.mark.parametrize("encoder", ["carl", "patch"])
def test_bfloat16_is_the_type_of_all_large_products(encoder):
    """All but the last layer of each head, forward and backward, as an accelerator gets them."""
    obs = _obs(8, 64)
    network = ActorCritic(NetworkConfig(encoder=encoder, compute_dtype="bfloat16"))
    params = jax.eval_shape(network.init, jax.random.key(0), obs)

    def loss(params):
        return sum(jnp.sum(x) for x in network.apply(params, obs))

    traced = jax.jit(jax.value_and_grad(loss)).trace(params)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    products = [line for line in text.splitlines() if re.search("dot_general|convolution", line)]
    types = [re.findall(r"tensor<(?:\d+x)*(\w+)>", line) for line in products]
    assert {name for each in types for name in each} == {"f32", "bf16"}
    # alpha, beta and value: forward, and the gradients of weights and inputs.
    assert sum("f32" in each for each in types) == 9
    assert sum("f32" not in each for each in types) > 20
