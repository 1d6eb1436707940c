"""LayerNorm over whole images, with its gradient written out.

y = scale (x - mean) / sqrt(variance + eps) + bias for each image. Source: Ba, Kiros, Hinton, Layer
Normalization (2016). An image of the paper's first layer has 127,008 numbers, and XLA:CPU adds that
many up in windows, one number after the other; here sums are products with ones on a CPU. GPUs and
TPUs get plain sums.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
from flax import linen as nn


class LayerNorm(nn.Module):
    """LayerNorm over height, width and channels together.

    Attributes:
      epsilon: added to the variance.
      dtype: of the output; parameters and statistics are float32.
    """

    epsilon: float
    dtype: str = "float32"

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps (N, H, W, C) to as much."""
        scale = self.param("scale", nn.initializers.ones, x.shape[1:])
        bias = self.param("bias", nn.initializers.zeros, x.shape[1:])
        return layer_norm(x, scale, bias, self.epsilon).astype(self.dtype)


class Affine(nn.Module):
    """The parameters of a LayerNorm, for a layer that applies it itself."""

    @nn.compact
    def __call__(self, shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
        """Returns scale and bias of a shape, float32."""
        scale = self.param("scale", nn.initializers.ones, shape)
        return scale, self.param("bias", nn.initializers.zeros, shape)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def layer_norm(x: jax.Array, scale: jax.Array, bias: jax.Array, eps: float) -> jax.Array:
    """Normalises each image.

    Args:
      x: (N, H, W, C) float32 or bfloat16.
      scale: (H, W, C) float32.
      bias: (H, W, C) float32.
      eps: added to the variance.

    Returns:
      (N, H, W, C) float32.
    """
    return _layer_norm_fwd(x, scale, bias, eps)[0]


def _layer_norm_fwd(
    x: jax.Array, scale: jax.Array, bias: jax.Array, eps: float
) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    centred = x.astype(jnp.float32)
    mean = _mean(centred)
    centred -= mean
    rate = jax.lax.rsqrt(_mean(jnp.square(centred)) + eps)
    return centred * rate * scale + bias, (x, scale, mean, rate)  # x is kept in its own type


def _layer_norm_bwd(
    eps: float, residuals: tuple[jax.Array, ...], g: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    del eps
    x, scale, mean, rate = residuals
    normal, inner = (x.astype(jnp.float32) - mean) * rate, g * scale
    # Neither mean nor size of an image can change: what would change them is taken out.
    dx = rate * (inner - _mean(inner) - normal * _mean(inner * normal))
    return dx.astype(x.dtype), (g * normal).sum(axis=0), g.sum(axis=0)


layer_norm.defvjp(_layer_norm_fwd, _layer_norm_bwd)


def _mean(x: jax.Array) -> jax.Array:
    """(N, 1, 1, 1) means of images."""
    size = math.prod(x.shape[1:])

    def product(x: jax.Array) -> jax.Array:
        ones = jnp.ones((*x.shape[1:], 1), x.dtype)
        return (jnp.tensordot(x, ones, axes=3) / size)[..., None, None]

    def plain(x: jax.Array) -> jax.Array:
        return x.mean(axis=(1, 2, 3), keepdims=True)

    return jax.lax.platform_dependent(x, cpu=product, default=plain)
