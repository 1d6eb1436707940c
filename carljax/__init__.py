"""CaRL in JAX: a 2D driving simulator, the CaRL reward and PPO as one compiled program."""

__version__ = "0.1.0"
