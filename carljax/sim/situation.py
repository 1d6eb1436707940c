"""What the ego's surroundings are after a step, looked up once for reward and observation."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import geometry, lights, route
from carljax.sim.right_of_way import EgoPlace
from carljax.sim.road_map import (
    LAYER_PARKING,
    LAYER_ROAD,
    LAYER_SHOULDER,
    RoadMap,
    layer_bits,
    nearest_lane,
)
from carljax.sim.route import Route
from carljax.sim.types import (
    LIGHT_GREEN,
    STOP_LIGHT,
    Agents,
    EgoState,
    LightClock,
    Others,
    Situation,
)

# Sample points along and across the ego's footprint, 0.6 m apart: the atlas resolves 0.5 m.
FOOTPRINT = (9, 4)
ON_ROUTE = 2.0  # m from the route within which the ego counts as on the route's own lane
OTHERS_AHEAD = 40  # route points ahead on which others are looked for
JUNCTION_LOOK_AHEAD = 18  # route points ahead at which the ego is seen to be about to enter a lane


def situation(
    ego: EgoState,
    ego_size: jax.Array,
    agents: Agents,
    road_map: RoadMap,
    stretch: Route,
    stretch_start: jax.Array,
    stretch_idx: jax.Array,
    clock: LightClock,
) -> Situation:
    """Looks up road and route.

    Args:
      ego: the ego.
      ego_size: (2,) its length and width, m.
      agents: the others.
      road_map: the map.
      stretch: window of the route around the ego.
      stretch_start: () int32, the window's first route index.
      stretch_idx: () int32, last passed point, counted from the window's start.
      clock: of the lights.

    Returns:
      The situation; its route index counts from the route's start.
    """
    lane = nearest_lane(road_map, stretch.town, ego.xy)
    centre = layer_bits(road_map, stretch.town, ego.xy)
    place = route.nearest(stretch, stretch_idx, ego.xy)
    return Situation(
        lane_lateral=lane.lateral,
        lane_yaw=lane.yaw,
        lane_width=lane.width,
        lane_z=lane.z,
        lane_in_junction=lane.in_junction,
        on_parking=(centre & LAYER_PARKING) > 0,
        off_road_frac=off_road_frac(ego, ego_size, road_map, stretch.town),
        corner_off_road=corner_off_road(ego, ego_size, road_map, stretch.town),
        route_idx=stretch_idx + stretch_start,
        route_s=stretch.s[stretch_idx],
        route_length=stretch.length,
        route_num_points=stretch.num_points + stretch_start,
        route_distance=route.distance(stretch, stretch_idx, ego.xy),
        route_lateral=geometry.to_frame(ego.xy, stretch.xy[place], stretch.yaw[place])[1],
        route_yaw=stretch.yaw[place],
        speed_limit=stretch.speed_limit[stretch_idx],
        stop_s=stretch.stop_s,
        stop_xy=stretch.stop_xy,
        stop_yaw=stretch.stop_yaw,
        stop_width=stretch.stop_width,
        stop_kind=stretch.stop_kind,
        stop_light=stop_lights(road_map, stretch, clock),
        others=others(ego, agents, road_map, stretch, stretch_idx),
    )


def stop_lights(road_map: RoadMap, stretch: Route, clock: LightClock) -> jax.Array:
    """(Q,) int32 LIGHT_* of each stop line of the route; LIGHT_GREEN where there is no light."""
    light = jnp.maximum(stretch.stop_light, 0)
    colour = lights.colour(light, clock, road_map)
    governed = (stretch.stop_kind == STOP_LIGHT) & (stretch.stop_light >= 0)
    return jnp.where(governed, colour, LIGHT_GREEN)


def yellow_left(road_map: RoadMap, stretch: Route, clock: LightClock) -> jax.Array:
    """(Q,) s of yellow that remain at each stop line's light."""
    light = jnp.maximum(stretch.stop_light, 0)
    return lights.yellow_left_of(light, clock, road_map)


def off_road_frac(
    ego: EgoState, ego_size: jax.Array, road_map: RoadMap, town: jax.Array
) -> jax.Array:
    """() fraction of the ego's footprint that is on neither road, parking lane nor shoulder."""
    along = jnp.linspace(-0.5, 0.5, FOOTPRINT[0], dtype=jnp.float32) * ego_size[0]
    across = jnp.linspace(-0.5, 0.5, FOOTPRINT[1], dtype=jnp.float32) * ego_size[1]
    grid = jnp.stack(jnp.meshgrid(along, across), axis=-1).reshape(-1, 2)
    bits = layer_bits(road_map, town, geometry.from_frame(grid, ego.xy, ego.yaw))
    drivable = (bits & (LAYER_ROAD | LAYER_PARKING | LAYER_SHOULDER)) > 0
    return 1.0 - drivable.mean(dtype=jnp.float32)


def corner_off_road(
    ego: EgoState, ego_size: jax.Array, road_map: RoadMap, town: jax.Array
) -> jax.Array:
    """(4,) bool, corners of the ego's box on neither road nor parking lane."""
    corners = geometry.box_corners(ego.xy, ego.yaw, ego_size[0], ego_size[1])
    return (layer_bits(road_map, town, corners) & (LAYER_ROAD | LAYER_PARKING)) == 0


def others(
    ego: EgoState, agents: Agents, road_map: RoadMap, stretch: Route, stretch_idx: jax.Array
) -> Others:
    """Looks up where the others are, on the road and ahead on the ego's route."""
    bits = layer_bits(road_map, stretch.town, agents.xy)
    ahead = stretch_idx + jnp.arange(OTHERS_AHEAD + 1)
    ahead = jnp.minimum(ahead, stretch.num_points - 1)
    apart = geometry.squared_distance(agents.xy[:, None], stretch.xy[ahead])  # (N, points)
    nearest = ahead[jnp.argmin(apart, axis=1)]
    offset = geometry.to_frame(agents.xy, stretch.xy[nearest], stretch.yaw[nearest])
    begin = geometry.to_frame(ego.xy, stretch.xy[stretch_idx], stretch.yaw[stretch_idx])[0]
    gap = stretch.s[nearest] + offset[:, 0] - (stretch.s[stretch_idx] + begin)
    # Past the last point looked at, or beside the first, one is not on this stretch.
    is_on = (jnp.abs(offset) < ON_ROUTE).all(axis=1) & (gap > 0.0)
    return Others(
        on_road=(bits & (LAYER_ROAD | LAYER_PARKING | LAYER_SHOULDER)) > 0,
        route_gap=jnp.where(is_on, gap, jnp.inf),
    )


def ego_place(ego: EgoState, road_map: RoadMap, stretch: Route, stretch_idx: jax.Array) -> EgoPlace:
    """Where traffic takes the ego to be: on its route's lane when near it, else the nearest."""
    nearest = nearest_lane(road_map, stretch.town, ego.xy)
    on_route = route.distance(stretch, stretch_idx, ego.xy) < ON_ROUTE
    offset = geometry.to_frame(ego.xy, stretch.xy[stretch_idx], stretch.yaw[stretch_idx])
    lane = jnp.where(on_route, stretch.lane[stretch_idx], nearest.lane)
    s = jnp.where(on_route, stretch.lane_s[stretch_idx] + offset[0], nearest.s)
    ahead = stretch_idx + jnp.arange(JUNCTION_LOOK_AHEAD + 1)
    coming = stretch.lane[jnp.minimum(ahead, stretch.num_points - 1)]
    other = coming != lane
    next_lane = jnp.where(on_route & other.any(), coming[jnp.argmax(other)], -1)
    return EgoPlace(lane=lane, next_lane=next_lane, s=s)
