"""Where actors stand beside a route, and from where nobody sees them appear. Host only."""

from __future__ import annotations

import numpy as np

from carljax.sim.respawn import VIEW_BACK, VIEW_FRONT, VIEW_SIDE
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.site import Place, Site

SIGHT_SLACK = 2.0  # m; the ego is not always on its route's line. source: ours
ARM_AHEAD = 15.0  # m before the last chance to appear unseen; a place may be taken. source: ours
FARTHEST_PAVEMENT = 20.0  # m to the side. source: ours, four lanes and a verge
STRIP = 1.5  # m along the road in which lanes beside a place are looked for. source: ours
VERGE = 1.5  # m beyond the road's edge, where there is no pavement. source: CARLA's scenario runner


def arm_s(site: Site, xy: np.ndarray) -> float:
    """Where on the route actors should take their places, at the trigger or before it.

    Args:
      site: of the scenario.
      xy: (n, 2) m, places of the actors.

    Returns:
      m on the route, shortly before the last place from where none of them is in sight; 0, the
      start of the episode, where there is no such place.
    """
    num = site.index + 1
    yaw = np.asarray(site.route.yaw[:num], float)[:, None]
    offset = np.reshape(xy, (1, -1, 2)) - np.asarray(site.route.xy[:num], float)[:, None]
    ahead = offset[..., 0] * np.cos(yaw) + offset[..., 1] * np.sin(yaw)
    left = offset[..., 1] * np.cos(yaw) - offset[..., 0] * np.sin(yaw)
    hidden = (ahead > VIEW_FRONT + SIGHT_SLACK) | (ahead < -VIEW_BACK - SIGHT_SLACK)
    hidden |= np.abs(left) > VIEW_SIDE + SIGHT_SLACK
    unseen = np.flatnonzero(hidden.all(axis=1))
    if len(unseen) == 0:
        return 0.0
    return max(0.0, float(site.route.s[unseen[-1]]) - ARM_AHEAD)


def outside_junction(site: Site, s: float) -> Place | None:
    """The first place on the route at an arc length or beyond it that is in no junction."""
    begin = site_module.place_at(site, s).index
    inside = np.asarray(site.route.in_junction[begin : int(site.route.num_points)])
    if inside.all():
        return None
    return site_module.place_at(site, float(site.route.s[begin + int(np.argmin(inside))]))


def beside(place: Place, ahead: float, left: float) -> np.ndarray:
    """(2,) m, the point that far ahead and to the left of a place on the route."""
    cos, sin = np.cos(place.yaw), np.sin(place.yaw)
    return place.xy + np.array([ahead * cos - left * sin, ahead * sin + left * cos])


def height(site: Site, place: Place) -> float:
    """Height of the road at a place, m."""
    table = site.town.lanes
    spacing = table.length[place.lane] / (table.num_points[place.lane] - 1)
    row = min(round(place.lane_s / spacing), int(table.num_points[place.lane]) - 1)
    return float(table.point_xyz[table.start[place.lane] + row, 2])


def pavement(site: Site, place: Place, side: float) -> float:
    """How far to the side of a place one stands beside the road, m.

    Args:
      site: of the scenario.
      place: on the route.
      side: 1 for the left, -1 for the right.

    Returns:
      m to the middle of the pavement, where there is one; else to the verge beyond the road's edge.
    """
    lanes = site.town.network.lanes
    xy, width, number = site.town.raw_points
    offset = xy - place.xy
    ahead = offset[:, 0] * np.cos(place.yaw) + offset[:, 1] * np.sin(place.yaw)
    across = side * (offset[:, 1] * np.cos(place.yaw) - offset[:, 0] * np.sin(place.yaw))
    near = (np.abs(ahead) < STRIP) & (across > -0.5) & (across < FARTHEST_PAVEMENT)
    roads = {lanes[row].road_id for row in site.town.lanes.members[place.lane]}
    walks, edges = [], [0.0]
    for at in np.flatnonzero(near):
        lane = lanes[number[at]]
        if lane.kind == "sidewalk":
            walks.append(across[at])
        elif lane.road_id in roads:
            edges.append(across[at] + 0.5 * width[at])
    walks = [to for to in walks if to > 1.0]
    return float(min(walks)) if walks else float(max(edges)) + VERGE
