"""The first layer over an image of bytes: convolution, LayerNorm and ReLU, a few images at a time.

At 256 px each of its arrays has half a megabyte an image, and to go through a whole micro-batch
with one after the other is to wait for memory. So on a CPU the layer, value and gradient, takes as
many images at a time as leave such an array in the cache. GPUs and TPUs take all at once.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import jax
import numpy as np

from carljax.ppo import pieces
from carljax.ppo.image_conv import image_conv
from carljax.ppo.layer_norm import layer_norm


class Params(NamedTuple):
    """Parameters of the layer.

    Attributes:
      kernel: (K, K, I, O) for bytes, of the type of products and output.
      bias: (O,) likewise.
      norm: (H', W', O) float32 scale and bias of LayerNorm; None without it.
    """

    kernel: jax.Array
    bias: jax.Array
    norm: tuple[jax.Array, jax.Array] | None


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def image_layer(x: jax.Array, params: Params, stride: int, eps: float) -> jax.Array:
    """Applies the layer; there is no gradient for the image.

    Args:
      x: (N, H, W, I) uint8.
      params: see `Params`.
      stride: of the convolution, which does not pad.
      eps: of LayerNorm.

    Returns:
      (N, H', W', O) of the kernel's type.
    """
    return _image_layer_fwd(x, params, stride, eps)[0]


def _image_layer_fwd(
    x: jax.Array, params: Params, stride: int, eps: float
) -> tuple[jax.Array, tuple[jax.Array, Params, jax.Array]]:
    z = image_conv(x, params.kernel, stride)

    def activate(z: jax.Array, params: Params) -> jax.Array:
        return _activate(params, z, eps)

    def by_pieces(z: jax.Array, params: Params) -> jax.Array:
        return pieces.map_over(lambda z: activate(z, params), _images_at_once(z), z)

    y = jax.lax.platform_dependent(z, params, cpu=by_pieces, default=activate)
    return y, (x, params, z)


def _image_layer_bwd(
    stride: int, eps: float, residuals: tuple[jax.Array, Params, jax.Array], g: jax.Array
) -> tuple[np.ndarray, Params]:
    x, params, z = residuals

    def gradient(x: jax.Array, z: jax.Array, g: jax.Array, params: Params) -> Params:
        _, pull_back = jax.vjp(functools.partial(_activate, eps=eps), params, z)
        grads, dz = pull_back(g)
        (dw,) = jax.vjp(lambda w: image_conv(x, w, stride), params.kernel)[1](dz)
        return grads._replace(kernel=dw)

    def by_pieces(x: jax.Array, z: jax.Array, g: jax.Array, params: Params) -> Params:
        size = _images_at_once(z)
        return pieces.sum_over(lambda x, z, g: gradient(x, z, g, params), size, x, z, g)

    grads = jax.lax.platform_dependent(x, z, g, params, cpu=by_pieces, default=gradient)
    return np.zeros(x.shape, jax.dtypes.float0), grads


image_layer.defvjp(_image_layer_fwd, _image_layer_bwd)


def _activate(params: Params, z: jax.Array, eps: float) -> jax.Array:
    z = z + params.bias
    if params.norm is not None:
        z = layer_norm(z, *params.norm, eps).astype(z.dtype)
    return jax.nn.relu(z)


def _images_at_once(z: jax.Array) -> int:
    """So many that one of the layer's arrays, as floats, stays in the cache."""
    return pieces.size_of(z.shape[0], 4 * math.prod(z.shape[1:]))
