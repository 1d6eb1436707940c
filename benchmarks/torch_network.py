"""The actor-critic of `carljax.ppo.networks` in PyTorch, laid out to be fast on a CPU.

Images are channels-last from the bytes to the last feature map, as oneDNN likes them: a LayerNorm
then works on contiguous (H, W, C) rows, and the 1 / 255 goes onto the first weights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from carljax.ppo.config import NetworkConfig
from carljax.ppo.networks import CONV_LAYERS, NORM_EPS, conv_fit

Outputs = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
# A place in flax's parameters, PyTorch's parameter, and from the array there to the one here.
Pair = tuple[tuple[str, ...], nn.Parameter, Callable[[np.ndarray], np.ndarray]]


class Norm(nn.Module):
    """LayerNorm over the last axes."""

    def __init__(self, *shape: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(shape))
        self.bias = nn.Parameter(torch.zeros(shape))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalises; shapes stay."""
        shape = self.scale.shape
        return functional.layer_norm(x, tuple(shape), self.scale, self.bias, NORM_EPS)


class Encoder(nn.Module):
    """Convolutions, or patches as convolutions whose stride is their kernel."""

    def __init__(self, config: NetworkConfig, image: tuple[int, int, int]) -> None:
        super().__init__()
        self.convs, self.norms, self.padding = nn.ModuleList(), nn.ModuleList(), []
        *size, channels = image
        for features, kernel, stride, padding in _layers(config, size):
            self.padding.append([x for pair in reversed(padding) for x in pair])
            self.convs.append(nn.Conv2d(channels, features, kernel, stride))
            size = [
                (n + sum(pad) - kernel) // stride + 1 for n, pad in zip(size, padding, strict=True)
            ]
            channels = features
            if config.layer_norm:
                shape = (features,) if config.encoder == "patch" else (*size, features)
                self.norms.append(Norm(*shape))
        self.num_features = channels * size[0] * size[1]

    def forward(self, raster: torch.Tensor) -> torch.Tensor:
        """Maps (N, H, W, C) uint8 to (N, features) of the weights' type."""
        convs: Any = self.convs
        x = raster.to(convs[0].weight.dtype).permute(0, 3, 1, 2)  # in memory still N, H, W, C
        for i, conv in enumerate(convs):
            if any(self.padding[i]):
                x = functional.pad(x, self.padding[i])
            weight = conv.weight * (1.0 / 255.0) if i == 0 else conv.weight
            weight = weight.contiguous(memory_format=torch.channels_last)
            x = functional.conv2d(x, weight, conv.bias, conv.stride)
            if len(self.norms):
                x = self.norms[i](x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
            x = functional.relu(x)
        return x.permute(0, 2, 3, 1).reshape(x.shape[0], -1)


def _layers(
    config: NetworkConfig, size: list[int]
) -> Iterator[tuple[int, int, int, list[tuple[int, int]]]]:
    """Features, kernel, stride and padding of each layer."""
    if config.encoder == "patch":
        for kernel, features in zip((config.patch_size, 2), config.patch_features, strict=True):
            padding = [(0, -n % kernel) for n in size]
            yield features, kernel, kernel, padding
            size = [-(-n // kernel) for n in size]
        return
    for features, kernel, stride in CONV_LAYERS[config.encoder]:
        padding, stride = conv_fit(tuple(size), kernel, stride)
        yield features, kernel, stride, padding
        size = [(n + sum(p) - kernel) // stride + 1 for n, p in zip(size, padding, strict=True)]


class Mlp(nn.Module):
    """Linear layers, each followed by LayerNorm and ReLU."""

    def __init__(self, config: NetworkConfig, *sizes: int) -> None:
        super().__init__()
        pairs = list(zip(sizes, sizes[1:], strict=False))
        self.linears = nn.ModuleList(nn.Linear(*pair) for pair in pairs)
        self.norms = nn.ModuleList(Norm(n) for _, n in pairs if config.layer_norm)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Maps (N, I) to (N, the last size)."""
        for i, linear in enumerate(self.linears):
            x = linear(x)
            x = functional.relu(self.norms[i](x) if len(self.norms) else x)
        return x


class Network(nn.Module):
    """The whole network.

    Attributes:
      config: as ours.
    """

    def __init__(
        self,
        config: NetworkConfig,
        image: tuple[int, int, int],
        num_scalars: int,
        num_value_scalars: int,
        action_size: int = 2,
    ) -> None:
        super().__init__()
        self.config = config
        self.encoder = Encoder(config, image)
        hidden = config.hidden_size
        self.scalar_mlp = Mlp(config, num_scalars, hidden, hidden)
        num_joint = self.encoder.num_features + hidden
        self.joint_mlp = Mlp(config, num_joint, config.joint_size, hidden)
        self.policy_mlp = Mlp(config, hidden, hidden, hidden)
        num_critic = hidden + (num_value_scalars if config.asymmetric_critic else 0)
        self.value_mlp = Mlp(config, num_critic, hidden, hidden)
        self.alpha, self.beta = nn.Linear(hidden, action_size), nn.Linear(hidden, action_size)
        self.value = nn.Linear(hidden, 1)

    def forward(
        self, raster: torch.Tensor, scalars: torch.Tensor, value_scalars: torch.Tensor
    ) -> Outputs:
        """Returns (N, A) alpha, (N, A) beta and (N,) value of (N, ...) observations."""
        joint = torch.cat([self.encoder(raster), self.scalar_mlp(scalars)], dim=1)
        features = self.joint_mlp(joint)
        policy = self.policy_mlp(features)
        least = self.config.beta_min
        alpha = functional.softplus(self.alpha(policy)) + least
        beta = functional.softplus(self.beta(policy)) + least
        if self.config.asymmetric_critic:
            features = torch.cat([features, value_scalars], dim=1)
        return alpha, beta, self.value(self.value_mlp(features))[:, 0]


def pairs(network: Network) -> Iterator[Pair]:
    """Which of our parameters is which of PyTorch's."""
    convs: Any = network.encoder.convs
    for i, conv in enumerate(convs):
        yield ("encoder", f"kernel_{i}"), conv.weight, lambda x: x.transpose(3, 2, 0, 1)
        yield ("encoder", f"bias_{i}"), conv.bias, lambda x: x
    yield from _norms(("encoder",), network.encoder.norms)
    for name in ("scalar_mlp", "joint_mlp", "policy_mlp", "value_mlp"):
        mlp: Any = getattr(network, name)
        for i, linear in enumerate(mlp.linears):
            yield from _linear((name, f"Linear_{i}"), linear)
        yield from _norms((name,), mlp.norms)
    for name in ("alpha", "beta", "value"):
        yield from _linear((name,), getattr(network, name))


def _linear(path: tuple[str, ...], linear: Any) -> Iterator[Pair]:
    yield (*path, "kernel"), linear.weight, lambda x: x.T
    yield (*path, "bias"), linear.bias, lambda x: x


def _norms(path: tuple[str, ...], norms: Any) -> Iterator[Pair]:
    for i, norm in enumerate(norms):
        yield (*path, f"LayerNorm_{i}", "scale"), norm.scale, lambda x: x
        yield (*path, f"LayerNorm_{i}", "bias"), norm.bias, lambda x: x


def at(variables: Any, path: tuple[str, ...]) -> np.ndarray:
    """Our array at a place of flax's variables (or of gradients of the same structure)."""
    tree = variables["params"]
    for name in path:
        tree = tree[name]
    return np.asarray(tree)


def load(network: Network, variables: Any) -> None:
    """Copies our parameters into PyTorch's network.

    Raises:
      ValueError: a shape differs, or there are more or fewer of them.
    """
    num = 0
    for path, parameter, turned in pairs(network):
        array = turned(at(variables, path))
        if array.shape != tuple(parameter.shape):
            raise ValueError(f"{'/'.join(path)}: {array.shape} is not {tuple(parameter.shape)}")
        parameter.data = torch.from_numpy(np.ascontiguousarray(array).copy())
        num += 1
    leaves = sum(1 for _ in network.parameters())
    if num != leaves:
        raise ValueError(f"{num} arrays were copied into a network of {leaves}")
