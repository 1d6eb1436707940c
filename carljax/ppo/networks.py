"""The actor-critic: image encoder, scalar branch, joint trunk, Beta policy head, asymmetric critic.

Source: CaRL paper, "Architecture", after Roach (Zhang et al. 2021). Every layer is linear or
convolution, then LayerNorm, then ReLU; the LayerNorm of a convolution spans height, width and
channels together and has an affine weight for each. The critic alone sees the value scalars.
Weights start as in the authors' code: linear layers by PyTorch's default, convolutions by
`NetworkConfig.conv_init`, LayerNorms at 1 and 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from carljax.ppo import image_layer
from carljax.ppo.config import NetworkConfig
from carljax.ppo.conv import conv, matmul, patch_conv
from carljax.ppo.layer_norm import Affine, LayerNorm
from carljax.sim.types import Observation

# Channels, kernel, stride of each convolution. source: CaRL paper, "Architecture" (and Roach's).
CONV_LAYERS = {
    "carl": ((8, 5, 2), (16, 5, 2), (24, 5, 2), (32, 5, 2), (64, 3, 2), (128, 3, 1), (256, 3, 1)),
    "roach": ((8, 5, 2), (16, 5, 2), (32, 5, 2), (64, 3, 2), (128, 3, 2), (256, 3, 1)),
}
CONV_BIAS = 0.1  # source: Roach's initialisation, kept by CaRL
NORM_EPS = 1e-5  # source: PyTorch's default, which the paper's trainer used
_BYTE = np.float32(1.0 / 255.0)  # of a pixel's largest value, 1
_MIN_SIZE = 2  # height and width of the paper's last feature map

_xavier = nn.initializers.variance_scaling(2.0, "fan_avg", "uniform")  # with ReLU's gain, sqrt 2


class ActorCritic(nn.Module):
    """The whole network.

    Attributes:
      config: sizes and encoder.
      action_size: dimensions of the action.
    """

    config: NetworkConfig
    action_size: int = 2

    @nn.compact
    def __call__(self, obs: Observation) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Returns policy and value.

        Args:
          obs: (N,) observations; raster uint8, scalars as they are.

        Returns:
          (N, A) alpha, (N, A) beta, (N,) value, all float32.
        """
        config = self.config
        image = _encoder(config)(obs.raster)
        scalars = Mlp(config, (config.hidden_size, config.hidden_size), name="scalar_mlp")(
            obs.scalars
        )
        joint = jnp.concatenate([image, scalars], axis=-1)
        features = Mlp(config, (config.joint_size, config.hidden_size), name="joint_mlp")(joint)
        head = (config.hidden_size, config.hidden_size)
        policy = Mlp(config, head, name="policy_mlp")(features)
        alpha = nn.softplus(Linear(self.action_size, name="alpha")(policy)) + config.beta_min
        beta = nn.softplus(Linear(self.action_size, name="beta")(policy)) + config.beta_min
        if config.asymmetric_critic:
            features = jnp.concatenate([features, obs.value_scalars], axis=-1)
        critic = Mlp(config, head, name="value_mlp")(features)
        return alpha, beta, Linear(1, name="value")(critic)[..., 0]


def forward(
    network: ActorCritic, params: Any, obs: Observation
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns `network.apply(params, obs)`, which flax leaves without a type."""
    outputs: Any = network.apply(params, obs)
    return outputs


class Linear(nn.Module):
    """A linear layer with PyTorch's default initialisation.

    Attributes:
      features: of the output.
      dtype: of product and output; the parameters are float32.
    """

    features: int
    dtype: str = "float32"

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps (N, I) to (N, features)."""
        init = _torch_init(x.shape[-1])
        kernel = self.param("kernel", init, (x.shape[-1], self.features))
        bias = self.param("bias", init, (self.features,))
        return matmul(x.astype(self.dtype), kernel.astype(self.dtype)) + bias.astype(self.dtype)


class Mlp(nn.Module):
    """Linear layers, each followed by LayerNorm and ReLU."""

    config: NetworkConfig
    sizes: tuple[int, ...]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps (N, I) to (N, sizes[-1])."""
        dtype = self.config.compute_dtype
        for size in self.sizes:
            x = Linear(size, dtype)(x)
            if self.config.layer_norm:
                x = nn.LayerNorm(epsilon=NORM_EPS, dtype=dtype)(x)
            x = nn.relu(x)
        return x


class ConvEncoder(nn.Module):
    """The paper's convolutions, for an image of any size.

    At 256 px (carl) and 192 px (roach) this is the paper's network. A smaller image would vanish
    on the way: a layer whose output would have less than 2 rows or columns is padded as "SAME" at
    its stride, and if that is still too small its stride becomes 1. So 64 and 128 px end in 2 x 2
    x 256 features too.
    """

    config: NetworkConfig

    @nn.compact
    def __call__(self, raster: jax.Array) -> jax.Array:
        """Maps (N, H, W, C) uint8 to (N, features) of `NetworkConfig.compute_dtype`."""
        x, dtype = raster, self.config.compute_dtype
        for i, (features, kernel, stride) in enumerate(CONV_LAYERS[self.config.encoder]):
            weight, bias = _conv_params(self, i, (kernel, kernel, x.shape[-1], features))
            padding, stride = conv_fit(x.shape[1:3], kernel, stride)
            x = jnp.pad(x, ((0, 0), *padding, (0, 0)))
            name = f"LayerNorm_{i}"
            if i == 0:
                x = self._image_layer(x, weight, bias, stride, name)
                continue
            x = conv(x, weight.astype(dtype), stride)
            x += bias.astype(dtype)
            if self.config.layer_norm:
                x = LayerNorm(NORM_EPS, dtype, name=name)(x)
            x = nn.relu(x)
        return x.reshape(x.shape[0], -1)

    def _image_layer(
        self, x: jax.Array, weight: jax.Array, bias: jax.Array, stride: int, norm_name: str
    ) -> jax.Array:
        """The first layer: uint8 goes in as it is and the 1 / 255 onto the weights."""
        dtype, norm = self.config.compute_dtype, None
        if self.config.layer_norm:
            out = [(size - weight.shape[0]) // stride + 1 for size in x.shape[1:3]]
            norm = Affine(name=norm_name)((*out, weight.shape[-1]))
        weight = weight * _BYTE
        params = image_layer.Params(weight.astype(dtype), bias.astype(dtype), norm)
        return image_layer.image_layer(x, params, stride, NORM_EPS)


def conv_fit(size: tuple[int, ...], kernel: int, stride: int) -> tuple[list[tuple[int, int]], int]:
    """Chooses padding and stride of a layer by the rule of `ConvEncoder`.

    Args:
      size: height and width of the layer's input.
      kernel: side of its kernel.
      stride: the paper's stride.

    Returns:
      Padding before and after each axis, and the stride to use.
    """
    if (min(size) - kernel) // stride + 1 >= _MIN_SIZE:
        return [(0, 0), (0, 0)], stride
    if -(-min(size) // stride) < _MIN_SIZE:
        stride = 1
    totals = [max((-(-n // stride) - 1) * stride + kernel - n, 0) for n in size]
    return [(total // 2, total - total // 2) for total in totals], stride


class PatchEncoder(nn.Module):
    """Convolutions whose stride is their kernel: a reshape and a matrix product, fast on a CPU.

    Patches of the image, then 2 x 2 of those; edges are padded with zeros to whole patches.
    """

    config: NetworkConfig

    @nn.compact
    def __call__(self, raster: jax.Array) -> jax.Array:
        """Maps (N, H, W, C) uint8 to (N, features) of `NetworkConfig.compute_dtype`."""
        x, dtype = raster, self.config.compute_dtype
        sizes = (self.config.patch_size, 2)
        # uint8 goes in as it is and the 1 / 255 onto the weights: one pass less over the image.
        scales = (_BYTE, np.float32(1.0))
        layers = zip(sizes, self.config.patch_features, scales, strict=True)
        for i, (size, features, scale) in enumerate(layers):
            weight, bias = _conv_params(self, i, (size, size, x.shape[-1], features))
            padding = [(0, -n % size) for n in x.shape[1:3]]
            x = jnp.pad(x, ((0, 0), *padding, (0, 0)))
            x = patch_conv(x, (weight * scale).astype(dtype), size) + bias.astype(dtype)
            if self.config.layer_norm:
                x = nn.LayerNorm(epsilon=NORM_EPS, dtype=dtype)(x)
            x = nn.relu(x)
        return x.reshape(x.shape[0], -1)


def _conv_params(
    encoder: ConvEncoder | PatchEncoder, i: int, shape: tuple[int, int, int, int]
) -> tuple[jax.Array, jax.Array]:
    """Returns (K, K, I, O) weights and (O,) bias of an encoder's layer i."""
    kernel_init: Any = _xavier
    bias_init: Any = nn.initializers.constant(CONV_BIAS)
    if encoder.config.conv_init == "torch":
        kernel_init = bias_init = _torch_init(math.prod(shape[:-1]))
    return (
        encoder.param(f"kernel_{i}", kernel_init, shape),
        encoder.param(f"bias_{i}", bias_init, shape[-1:]),
    )


def _torch_init(fan_in: int) -> Callable[[jax.Array, tuple[int, ...]], jax.Array]:
    """PyTorch's default for weights and biases: uniform in +-1 / sqrt(inputs)."""
    bound = fan_in**-0.5

    def init(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        return jax.random.uniform(key, shape, minval=-bound, maxval=bound)

    return init


def _encoder(config: NetworkConfig) -> nn.Module:
    if config.encoder == "patch":
        return PatchEncoder(config, name="encoder")
    return ConvEncoder(config, name="encoder")
