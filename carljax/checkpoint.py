"""Checkpoints of a run: the whole training state, saved and restored with Orbax.

A checkpoint is a folder `checkpoints/<update>` that appears in one rename, so a run that is cut off
never leaves half of one. It has two items: `params`, all that evaluation needs, and `learner`, the
rest of the training state (optimiser, environments, random keys, update count), with which
training goes on exactly as if it had never stopped. The newest few are kept, and the one with the
best score.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers

FOLDER = "checkpoints"


class CheckpointError(ValueError):
    """A checkpoint that is missing or does not fit: one line that says which and why."""


def save(run_dir: Path, train_state: Any, update: int, score: float, keep: int) -> None:
    """Saves the training state and drops checkpoints that are neither new nor best.

    Args:
      run_dir: the run's directory.
      train_state: a `TrainState`.
      update: updates made so far; names the checkpoint.
      score: what "best" compares, higher is better; NaN where there is none yet.
      keep: how many of the newest to keep.
    """
    params, learner = _split(train_state)
    with _manager(run_dir, keep) as manager:
        if update in manager.all_steps():
            return
        manager.save(
            update,
            args=ocp.args.Composite(
                params=ocp.args.StandardSave(params), learner=ocp.args.StandardSave(learner)
            ),
            metrics={"score": score} if math.isfinite(score) else None,
        )


def restore(run_dir: Path, like: Any, update: int | None = None) -> Any:
    """Restores a training state, onto as many devices as `like` lies on.

    Args:
      run_dir: the run's directory.
      like: a `TrainState` of the same structure, shapes and dtypes; its shardings are used.
      update: which checkpoint; the newest by default.

    Returns:
      The saved values laid out like `like`.
    """
    params, learner = _split(like)
    with _manager(run_dir) as manager:
        step = _pick(manager, run_dir, update)
        restored = _restore_items(manager, run_dir, step, params=params, learner=learner)
    return _join(like, restored["params"], restored["learner"])


def restore_params(run_dir: Path, like: Any, update: int | None = None) -> Any:
    """Restores the network's parameters alone.

    Args:
      run_dir: the run's directory.
      like: parameters of the same structure, shapes and dtypes.
      update: which checkpoint; the newest by default.

    Returns:
      The saved parameters laid out like `like`.
    """
    with _manager(run_dir) as manager:
        step = _pick(manager, run_dir, update)
        return _restore_items(manager, run_dir, step, params=like)["params"]


def updates(run_dir: Path) -> list[int]:
    """Lists the updates of which there is a checkpoint, ascending."""
    if not (run_dir / FOLDER).is_dir():
        return []
    with _manager(run_dir) as manager:
        return sorted(manager.all_steps())


def best(run_dir: Path) -> int | None:
    """Finds the checkpoint with the best score, the newest one where none has a score."""
    if not (run_dir / FOLDER).is_dir():
        return None
    with _manager(run_dir) as manager:
        step = manager.best_step()
        return manager.latest_step() if step is None else step


def _score(metrics: Any) -> float:
    return metrics["score"]


@contextmanager
def _manager(run_dir: Path, keep: int | None = None) -> Iterator[ocp.CheckpointManager]:
    """Opens the run's checkpoints; only with `keep` for writing."""
    with _quiet():
        manager = ocp.CheckpointManager((run_dir / FOLDER).absolute(), options=_options(keep))
        try:
            yield manager
        finally:
            manager.close()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps Orbax's notes about options chosen on purpose off the terminal; errors pass."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _options(keep: int | None) -> ocp.CheckpointManagerOptions:
    policies = checkpoint_managers
    return ocp.CheckpointManagerOptions(
        create=keep is not None,
        read_only=keep is None,
        cleanup_tmp_directories=keep is not None,
        enable_async_checkpointing=False,
        best_fn=_score,
        preservation_policy=policies.AnyPreservationPolicy(
            [
                policies.LatestN(keep),
                policies.BestN(get_metric_fn=_score, n=1, keep_checkpoints_without_metrics=False),
            ]
        ),
    )


def _pick(manager: ocp.CheckpointManager, run_dir: Path, update: int | None) -> int:
    steps = sorted(manager.all_steps())
    if not steps:
        raise CheckpointError(f"{run_dir}: no checkpoint in {FOLDER}/")
    if update is None:
        return steps[-1]
    if update not in steps:
        raise CheckpointError(f"{run_dir}: no checkpoint of update {update}; there are {steps}")
    return update


def _restore_items(
    manager: ocp.CheckpointManager, run_dir: Path, step: int, **likes: Any
) -> dict[str, Any]:
    wanted = {
        name: ocp.args.StandardRestore(jax.tree.map(ocp.utils.to_shape_dtype_struct, like))
        for name, like in likes.items()
    }
    try:
        restored = manager.restore(step, args=ocp.args.Composite(**wanted))
    except (ValueError, KeyError, TypeError) as error:
        reason = str(error).strip().split("\n", 1)[0]
        raise CheckpointError(
            f"{run_dir / FOLDER / str(step)}: does not fit the configured training state: {reason}"
        ) from error
    return {name: restored[name] for name in likes}


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _split(train_state: Any) -> tuple[Any, dict[str, Any]]:
    """Parts a training state into parameters and the rest, random keys as their raw words."""
    raw = jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, train_state)
    # Orbax saves no array without elements, and there is nothing in it to save.
    raw = jax.tree.map(lambda x: x if x.size else None, raw)
    fields = {field.name: getattr(raw, field.name) for field in dataclasses.fields(raw)}
    # What a run doesn't have leaves no trace, so parts that came later don't make it unreadable.
    learner = {name: value for name, value in fields.items() if value is not None}
    return raw.params, {**learner, "params": None}


def _join(like: Any, params: Any, learner: dict[str, Any]) -> Any:
    def back(x: Any, saved: Any) -> Any:
        if saved is None:  # an array without elements
            return x
        if _is_key(x):
            return jax.random.wrap_key_data(saved, impl=jax.random.key_impl(x))
        return saved

    return jax.tree.map(back, like, like.replace(**{**learner, "params": params}))
