"""One moment of an episode as a picture: where the ego is, what the policy sees and does.

Left the town from above, north up, with route and agents (those of scenarios outlined); right the
bird's-eye image that is the policy's input; below speed, action, the reward's terms and scenarios
by name. NumPy and Pillow on the host. The terms are those of the CaRL reward, by whose terms drives
are evaluated whatever the policy was trained with.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from carljax.render import image
from carljax.reward.carl import SOFT_FACTORS
from carljax.sim import lights
from carljax.sim.env import DrivingEnv
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.road_map import PIXELS_PER_METRE, RoadMap, picture
from carljax.sim.scenarios import registry
from carljax.sim.scenarios.script import ScenarioSlots
from carljax.sim.types import (
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_YELLOW,
    STOP_LIGHT,
    STOP_NONE,
    LightClock,
    State,
)

MAP_SIDE_M = 140.0
PANEL = 320  # px, side of both pictures
MARGIN = 8
TEXT_HEIGHT = 168
ROW = 18  # px, line of text

BACKGROUND, TEXT, DIM = (24, 26, 30), (232, 232, 228), (110, 114, 120)
AHEAD, STOP = (86, 156, 255), (226, 226, 214)
GOOD, BAD = (98, 190, 120), (226, 92, 82)
EGO, SCENARIO = (255, 196, 57), (255, 64, 200)
AGENT_COLOURS = {
    KIND_VEHICLE: (205, 214, 226),
    KIND_PEDESTRIAN: (255, 200, 90),
    KIND_STATIC: image.STATIC,
}
LIGHT_COLOURS = {LIGHT_GREEN: image.GREEN, LIGHT_YELLOW: image.YELLOW, LIGHT_RED: image.RED}


@dataclasses.dataclass(frozen=True)
class World:
    """What stands still in an episode, on the host.

    Attributes:
      layers: (H, W) uint8, the town's atlas at `PIXELS_PER_METRE`, row = y.
      origin: (2,) m, centre of pixel [0, 0].
      route_xy: (R, 2) m.
      route_yaw: (R,) rad.
      stop_idx, stop_kind, stop_light, stop_width: (Q,) of the route's stop lines.
      road_map: all towns, on the device.
      scenario_kind: (E,) int32, places in `registry.KINDS`, of the route's scenarios.
      actors: rows of `Agents` that belong to scenarios.
      ego_size: length and width, m.
    """

    layers: np.ndarray
    origin: np.ndarray
    route_xy: np.ndarray
    route_yaw: np.ndarray
    stop_idx: np.ndarray
    stop_kind: np.ndarray
    stop_light: np.ndarray
    stop_width: np.ndarray
    road_map: RoadMap
    scenario_kind: np.ndarray
    actors: slice
    ego_size: tuple[float, float]


def read_world(env: DrivingEnv, episode_idx: int) -> World:
    """Fetches the town and the route of an episode from the device."""
    routes, road_map = env.bank.routes, env.bank.road_map
    route = jax.device_get(jax.tree.map(lambda x: x[episode_idx], routes))
    town, rows = int(route.town), env.config.population
    return World(
        layers=picture(road_map, town, road_map.layers),
        origin=np.asarray(road_map.origin[town]),
        route_xy=route.xy[: int(route.num_points)],
        route_yaw=route.yaw,
        stop_idx=route.stop_idx,
        stop_kind=route.stop_kind,
        stop_light=route.stop_light,
        stop_width=route.stop_width,
        road_map=road_map,
        scenario_kind=np.asarray(env.bank.scenarios.kind[episode_idx]),
        actors=slice(rows.cars.start, rows.others.stop),
        ego_size=(float(env.vehicle.length), float(env.vehicle.width)),
    )


def frame(env: DrivingEnv, world: World, state: State, command: np.ndarray) -> Image.Image:
    """Draws one moment.

    Args:
      env: for the image's configuration.
      world: see `read_world`.
      state: unbatched, on the host.
      command: (2,) action that led to it.

    Returns:
      RGB picture.
    """
    width = 2 * PANEL + 3 * MARGIN
    canvas = Image.new("RGB", (width, PANEL + TEXT_HEIGHT + 2 * MARGIN), BACKGROUND)
    canvas.paste(map_view(world, state), (MARGIN, MARGIN))
    config = env.config
    seen = policy_view(np.asarray(state.obs.raster), config.raster, config.observation)
    canvas.paste(seen, (PANEL + 2 * MARGIN + (PANEL - seen.width) // 2, MARGIN))
    draw = ImageDraw.Draw(canvas)
    _draw_numbers(draw, state, command, PANEL + 2 * MARGIN)
    _draw_scenarios(draw, world, state, PANEL + 2 * MARGIN)
    return canvas


def policy_view(raster: np.ndarray, config: RasterConfig, kind: str = "carla") -> Image.Image:
    """Colours the policy's image, as large as the panel allows without distorting it.

    Args:
      raster: (H, W, C) uint8.
      config: its size.
      kind: of `observation.KINDS`.

    Returns:
      RGB picture.
    """
    scale = PANEL / max(raster.shape[:2])
    picture = image.bev_image(raster, config, scale=max(1, int(scale)), kind=kind)
    size = (round(raster.shape[1] * scale), round(raster.shape[0] * scale))
    return Image.fromarray(picture).resize(size, Image.Resampling.NEAREST)


def map_view(world: World, state: State) -> Image.Image:
    """Draws the town around the ego, north up: route, stop lines, agents, ego."""
    sim = state.pipeline_state
    scale = PANEL / MAP_SIDE_M
    centre = np.asarray(sim.ego.xy)
    view = Image.fromarray(_crop(world, centre)).resize((PANEL, PANEL), Image.Resampling.BILINEAR)
    draw = ImageDraw.Draw(view)

    def pixels(xy: np.ndarray) -> list[tuple[float, float]]:
        offset = (xy - centre) * scale
        return [(PANEL / 2 + x, PANEL / 2 - y) for x, y in np.atleast_2d(offset)]

    near = np.flatnonzero(np.abs(world.route_xy - centre).max(axis=1) < MAP_SIDE_M)
    ahead = near[near >= int(sim.route_idx)]
    if len(ahead) > 1:
        draw.line(pixels(world.route_xy[ahead[0] : ahead[-1] + 1]), fill=AHEAD, width=3)
    for q in range(len(world.stop_kind)):
        if world.stop_kind[q] != STOP_NONE:
            colour = _stop_colour(world, q, sim.lights)
            draw.line(pixels(_stop_line(world, q)), fill=colour, width=3)
    agents = sim.agents
    poses = np.column_stack([agents.xy, agents.yaw, agents.length, agents.width])
    is_actor = np.zeros(len(poses), bool)
    is_actor[world.actors] = True
    for kind, colour in AGENT_COLOURS.items():
        for n in np.flatnonzero(np.asarray(agents.kind) == kind):
            x, y, *rest = poses[n]
            outline = SCENARIO if is_actor[n] else colour
            draw.polygon(pixels(_corners(np.array([x, y]), *rest)), fill=colour, outline=outline)
    draw.polygon(pixels(_corners(centre, float(sim.ego.yaw), *world.ego_size)), fill=EGO)
    return view


def _crop(world: World, centre: np.ndarray) -> np.ndarray:
    """The square of the town's picture around a point, north up."""
    side = int(MAP_SIDE_M * PIXELS_PER_METRE)
    column, row = np.round((centre - world.origin) * PIXELS_PER_METRE).astype(int) - side // 2
    out = np.zeros((side, side), np.uint8)
    height, width = world.layers.shape
    top, bottom = np.clip([row, row + side], 0, height)
    left, right = np.clip([column, column + side], 0, width)
    out[top - row : bottom - row, left - column : right - column] = world.layers[
        top:bottom, left:right
    ]
    return image.map_image(out)


def _corners(xy: np.ndarray, yaw: float, length: float, width: float) -> np.ndarray:
    """(4, 2) m, corners of a box."""
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = 0.5 * length, 0.5 * width
    local = np.array([[x, y], [-x, y], [-x, -y], [x, -y]])
    return np.asarray(xy) + local @ np.array([[c, s], [-s, c]])


def _stop_line(world: World, q: int) -> np.ndarray:
    """(2, 2) m, ends of a stop line of the route."""
    idx = int(world.stop_idx[q])
    yaw = float(world.route_yaw[idx])
    across = np.array([-math.sin(yaw), math.cos(yaw)]) * float(world.stop_width[q]) / 2
    return world.route_xy[min(idx, len(world.route_xy) - 1)] + np.stack([across, -across])


def _stop_colour(world: World, q: int, clock: LightClock) -> tuple[int, int, int]:
    if world.stop_kind[q] != STOP_LIGHT:
        return STOP
    colour = lights.colour(world.stop_light[q], clock, world.road_map)
    return LIGHT_COLOURS[int(colour)]


def _draw_numbers(draw: ImageDraw.ImageDraw, state: State, command: np.ndarray, top: int) -> None:
    """Writes speed, action bars, completion and reward terms under the pictures."""
    font = ImageFont.load_default(13)
    ego, metrics = state.pipeline_state.ego, state.metrics
    speed = f"{3.6 * float(ego.speed):5.1f} km/h"
    limit = f"limit {3.6 * float(state.obs.scalars[7]):.0f}"
    done = f"route {float(metrics['episode/route_completion']):5.1f} %"
    seconds = f"return {float(metrics['episode/return']):.1f}"
    for row, text in enumerate((speed, limit, done, seconds)):
        draw.text((MARGIN, top + ROW * row), text, TEXT, font)
    steer, pedal = float(command[0]), float(command[1])
    bars = (("steer", steer), ("throttle", max(pedal, 0.0)), ("brake", max(-pedal, 0.0)))
    for row, (name, value) in enumerate(bars):
        y = top + ROW * row
        draw.text((130, y), name, TEXT, font)
        _bar(draw, (190, y + 3, 330, y + 14), -value if name == "steer" else value, name == "steer")
    for row, name in enumerate(SOFT_FACTORS):
        y, value = top + ROW * row, float(metrics[f"reward/{name}"])
        draw.text((360, y), name, TEXT if value > 0.999 else BAD, font)
        _bar(draw, (460, y + 3, 600, y + 14), value, False, GOOD if value > 0.999 else BAD)
    reward = f"reward {float(state.reward):+.3f} = {float(metrics['reward/progress']):.3f}"
    penalty = f" x factors - {float(metrics['reward/penalty']):.0f}"
    draw.text((MARGIN, top + ROW * 5 + 4), reward + penalty, TEXT, font)
    happened = [name for name in metrics if name.endswith("_frac") and float(metrics[name]) > 0]
    names = ", ".join(name.removeprefix("episode/").removesuffix("_frac") for name in happened)
    if names:
        text = f"the end: {names}" if float(state.done) > 0 else names
        draw.text((MARGIN, top + ROW * 6 + 6), text.replace("_", " "), BAD, font)


def scenario_names(world: World, slots: ScenarioSlots) -> list[str]:
    """Names of the scenarios whose actors are about; those that play are marked."""
    index, playing = np.asarray(slots.index), np.asarray(slots.is_playing)
    kinds = [int(world.scenario_kind[i]) for i in index[index >= 0]]
    names = [registry.KINDS[kind] for kind in kinds]
    return [f"> {n} <" if p else n for n, p in zip(names, playing[index >= 0], strict=True)]


def _draw_scenarios(draw: ImageDraw.ImageDraw, world: World, state: State, top: int) -> None:
    """Names the scenarios at the bottom right."""
    names = scenario_names(world, state.pipeline_state.scenarios)
    for row, name in enumerate(names):
        y = top + ROW * (len(SOFT_FACTORS) + row) + 4
        draw.text((360, y), name, SCENARIO, ImageFont.load_default(size=13))


def _bar(
    draw: ImageDraw.ImageDraw,
    box: tuple[int, int, int, int],
    value: float,
    is_centred: bool,
    colour: tuple[int, int, int] = AHEAD,
) -> None:
    """Draws a value in [0, 1], or in [-1, 1] from the middle."""
    left, top, right, bottom = box
    draw.rectangle(box, outline=DIM)
    zero = (left + right) / 2 if is_centred else left
    end = zero + value * (right - zero)
    draw.rectangle((min(zero, end), top, max(zero, end), bottom), fill=colour)
