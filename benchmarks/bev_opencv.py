"""Our image against OpenCV's: `python benchmarks/bev_opencv.py` (extra `bench`).

The same scenes (see `bev_scene`) at 256 x 256 x 10 px and 2 px/m, once as a compiled batch on one
device a core and once by one OpenCV process a core (see `bev_cv2`), in turn. Prints frames/s of
both, their ratio round by round, and the share of pixels that are equal in all ten channels. The
status is 1 where that is less than 99 %.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import math
import multiprocessing
import queue
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import bev_carljax
import bev_scene
import jax
import jax.numpy as jnp
import measure
import numpy as np
import tyro
from measure import UsageError

from carljax import machine, timing
from carljax.sim.raster_canvas import CHANNELS

LEAST_EQUAL = 0.99
TURN = 0.01  # rad that the ego turns from frame to frame, on either side


@dataclasses.dataclass(frozen=True)
class Command:
    """What to measure."""

    scenes: int = 8
    """Different scenes; ours draws so many at once, as many environments would."""
    steps: int = 80
    """Frames of each scene in a timed call, on either side."""
    repeats: int = 7
    """Timed calls of each side, at least 5, in turn."""
    processes: int | None = None
    """OpenCV processes; one for each core that this process may use by default."""
    devices: int | None = None
    """Devices that the CPU is made to look like for ours, which share the scenes; one for each core
    by default, or as many as divide the scenes. One alone uses all cores, too, but now and then it
    has work for only one."""


def main() -> int:
    """Draws, compares and times."""
    command = tyro.cli(Command, description=__doc__)
    try:
        check(command)
        machine.offer_devices(num_devices(command))
        line = compare(command)
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    measure.emit(line)
    return 0 if line["equal_pixels"] >= LEAST_EQUAL else 1


def check(command: Command) -> None:
    """Looks at the numbers and for OpenCV.

    Raises:
      UsageError: something is too small or missing.
    """
    measure.check_repeats(command.repeats)
    for name in ("scenes", "steps", "processes", "devices"):
        value = getattr(command, name)
        if value is not None and value < 1:
            raise UsageError(f"--{name} {value}: is below the least, 1")
    if command.scenes % num_devices(command):
        raise UsageError(f"--devices {command.devices}: {command.scenes} scenes don't divide so")
    if importlib.util.find_spec("cv2") is None:
        raise UsageError("OpenCV is not installed: pip install -e '.[bench]'")


def num_devices(command: Command) -> int:
    """Devices that share the scenes."""
    return command.devices or math.gcd(command.scenes, machine.num_cores())


def compare(command: Command) -> dict[str, Any]:
    """Makes the whole measurement, one line."""
    import bev_cv2  # here, so that a missing OpenCV is said in one line

    scenes = [bev_scene.make(seed) for seed in range(command.scenes)]
    roads = bev_scene.roads()
    given = bev_carljax.road_map(roads), bev_carljax.stack(scenes), jnp.float32(TURN)
    frames, given = bev_carljax.shared(command.steps, jax.devices()[: num_devices(command)], *given)
    program = measure.jit(frames)
    images = np.asarray(jax.block_until_ready(program(*given)))
    processes = command.processes or machine.num_cores()
    each = -(-command.scenes * command.steps // processes)
    ours, theirs = [], []
    with opencv(bev_cv2.work, processes, command.scenes) as draw:
        draw(each)
        for _ in range(command.repeats):
            ours += timing.call_seconds(program, lambda _: given, 1, warm_up=0)
            theirs.append(draw(each))
    our_speed = command.scenes * command.steps / np.array(ours)
    their_speed = each * processes / np.array(theirs)
    turned = TURN * command.steps
    expected = [bev_cv2.Renderer(roads).draw(scene, turned).copy() for scene in scenes]
    return {
        "benchmark": "bev_opencv",
        "ours_frames_per_s": float(np.median(our_speed)),
        "opencv_frames_per_s": float(np.median(their_speed)),
        "ours_over_opencv": measure.spread(list(our_speed / their_speed)),
        **equality(images, expected),
        "ours_seconds": measure.spread(ours),
        "opencv_seconds": measure.spread(theirs),
        "scenes": command.scenes,
        "steps": command.steps,
        "shared_by_devices": num_devices(command),
        "opencv_processes": processes,
        "opencv": bev_cv2.cv2.__version__,
        "shape": list(bev_carljax.CONFIG.shape),
    }


def equality(images: np.ndarray, planes: Sequence[np.ndarray]) -> dict[str, Any]:
    """How alike both sides' images are.

    Args:
      images: (B, H, W, 10) uint8, ours.
      planes: B times (10, H, W) uint8, OpenCV's.

    Returns:
      `equal_pixels`, the share of pixels with ten equal bytes over all images, `equal_pixels_least`
      of the image with the fewest; and of all bytes of a channel that are not 0 on both sides, the
      share that is equal.
    """
    theirs = np.moveaxis(np.stack(planes), 1, -1)
    same = images == theirs
    pixels = same.all(axis=-1).mean(axis=(1, 2))
    drawn = (images > 0) | (theirs > 0)
    return {
        "equal_pixels": float(pixels.mean()),
        "equal_pixels_least": float(pixels.min()),
        "equal_where_drawn": {
            name: round(float(same[..., c][drawn[..., c]].mean()), 4)
            for c, name in enumerate(CHANNELS)
            if drawn[..., c].any()
        },
    }


@contextlib.contextmanager
def opencv(
    work: Callable[..., None], processes: int, num_scenes: int
) -> Iterator[Callable[[int], float]]:
    """Starts the processes that draw with OpenCV; they wait while ours draws.

    Args:
      work: what they run, see `bev_cv2.work`.
      processes: how many.
      num_scenes: scenes, the same for all.

    Yields:
      draw(frames of each process) -> s from the first one's begin to the last one's end; it raises
      `UsageError` where a process has ended.
    """
    context = multiprocessing.get_context("spawn")
    tasks, results, barrier = context.Queue(), context.Queue(), context.Barrier(processes)
    given = (list(range(num_scenes)), TURN, tasks, results, barrier)
    workers = [context.Process(target=work, args=given, daemon=True) for _ in range(processes)]

    def draw(num_frames: int) -> float:
        for _ in workers:
            tasks.put(num_frames)
        spans: list[tuple[float, float]] = []
        while len(spans) < processes:
            try:
                spans.append(results.get(timeout=1.0))
            except queue.Empty:
                if not all(worker.is_alive() for worker in workers):
                    raise UsageError("a process that draws with OpenCV has ended") from None
        return max(end for _, end in spans) - min(begin for begin, _ in spans)

    for worker in workers:
        worker.start()
    try:
        yield draw
    finally:
        for _ in workers:
            tasks.put(0)
        for worker in workers:
            worker.join(timeout=5.0)
            worker.terminate()  # where another one's end has left it waiting


if __name__ == "__main__":
    sys.exit(main())
