"""The rewards in float64 NumPy, SciPy and Shapely, written apart from the package: one step each.

Everything is read off the formulas of the papers (docs/rewards.md). A memory is a dict that `begin`
makes and `step` changes. The road is whatever the situation says.
"""

import numpy as np
from scipy.signal import savgol_filter
from shapely.geometry import Polygon

LENGTH, WIDTH = 4.892, 1.836
VEHICLE, PEDESTRIAN = 1, 2
LIGHT, SIGN = 1, 2
YELLOW, RED = 1, 2
CARLA = [(-20, 10), (-9, 9), (-30, 30), (-30, 30), (-1.0, 1.0), (-3.0, 3.0)]
NUPLAN = [(-4.05, 2.4), (-4.89, 4.89), (-8.37, 8.37), (-4.13, 4.13), (-0.95, 0.95), (-1.93, 1.93)]
DT = 0.1


def box(xy, yaw, length, width):
    c, s = np.cos(yaw), np.sin(yaw)
    local = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.array([length, width]) / 2
    return Polygon(local @ np.array([[c, s], [-s, c]]) + xy)


def share(a, b):
    return a.intersection(b).area > 0


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


def begin(yaw, route_s):
    return {
        "lon": [], "lat": [], "yaw": [], "s": route_s, "ttc": 0, "comfort": np.zeros(6, int),
        "stood": 0.0, "far": 0.0, "honoured": None, "passed": None, "lateral": 0.0, "steps": 0,
    }  # fmt: skip


def touches(ego, agents, grow=1.0, least=0.0, kinds=(1, 2, 3)):
    me = box(ego.xy, ego.yaw, LENGTH, WIDTH)
    return any(
        share(
            me,
            box(
                agents.xy[i],
                agents.yaw[i],
                max(agents.length[i] * grow, least),
                max(agents.width[i] * grow, least),
            ),
        )
        for i in np.flatnonzero(np.isin(agents.kind, kinds))
        if abs(agents.z[i] - ego.z) < 3
    )


def arc(xy, course, yaw, speed, rate, t):
    if abs(rate) < 1e-9:
        return xy + speed * t * np.array([np.cos(course), np.sin(course)]), yaw
    end = course + rate * t
    way = [np.sin(end) - np.sin(course), np.cos(course) - np.cos(end)]
    return xy + speed / rate * np.array(way), yaw + rate * t


def meets_soon(ego, agents, least_speed):
    movers = np.isin(agents.kind, (VEHICLE, PEDESTRIAN)).any()
    if ego.speed < least_speed or not movers:
        return False
    for t in (0.2, 0.4, 0.6, 0.8, 1.0):
        me = arc(ego.xy, ego.yaw + ego.slip, ego.yaw, ego.speed, ego.yaw_rate, t)
        for i in np.flatnonzero(agents.kind > 0):
            it = arc(
                agents.xy[i], agents.yaw[i], agents.yaw[i], agents.speed[i], agents.yaw_rate[i], t
            )
            if share(box(*me, LENGTH, WIDTH), box(*it, agents.length[i], agents.width[i])):
                return True
    return False


def rough(memory, ego, limits):
    """Notes the motion; which of the six metrics are beyond their limits."""
    along, left = np.array([np.cos(ego.slip), np.sin(ego.slip)]), None
    left = np.array([-along[1], along[0]])
    accel = ego.accel * along + ego.speed * ego.yaw_rate * left
    for name, value in zip(("lon", "lat", "yaw"), (*accel, ego.yaw), strict=True):
        memory[name] = [*memory[name], float(value)][-15:]
    if len(memory["lon"]) < 8:
        return np.zeros(6, bool)
    lon, lat, yaw = np.array(memory["lon"]), np.array(memory["lat"]), np.unwrap(memory["yaw"])

    def smooth(x):
        return savgol_filter(x, 8, 2)

    def slope(x):
        return savgol_filter(smooth(x), min(15, len(x)), 2, deriv=1, delta=DT)[-1]

    values = [
        smooth(lon)[-1],
        smooth(lat)[-1],
        slope(np.hypot(lon, lat)),
        slope(lon),
        savgol_filter(yaw, 5, 2, deriv=1, delta=DT)[-1],
        savgol_filter(yaw, 5, 3, deriv=2, delta=DT)[-1],
    ]
    return np.array([not low <= v <= high for v, (low, high) in zip(values, limits, strict=True)])


def seen_from_line(xy, sit, q):
    c, s = np.cos(sit.stop_yaw[q]), np.sin(sit.stop_yaw[q])
    d = xy - sit.stop_xy[q]
    return np.array([c * d[0] + s * d[1], c * d[1] - s * d[0]])


def tail(ego, frac):
    return ego.xy - frac * LENGTH / 2 * np.array([np.cos(ego.yaw), np.sin(ego.yaw)])


def at_lines(memory, old, ego, sit):
    """Whether a red light, a stop sign is run in this step."""
    num = len(sit.stop_kind)
    if memory["honoured"] is None:
        memory["honoured"], memory["passed"] = np.zeros(num, bool), np.zeros(num, bool)
    ran = {"red_light": False, "stop_sign": False}
    for q in range(num):
        if abs(sit.stop_s[q] - sit.route_s) > 30:
            continue
        c, s = np.cos(sit.stop_yaw[q]), np.sin(sit.stop_yaw[q])
        strip = box(sit.stop_xy[q] - 1.5 * np.array([c, s]), sit.stop_yaw[q], 3, sit.stop_width[q])
        if sit.stop_kind[q] == SIGN and ego.speed < 0.1:
            memory["honoured"][q] |= share(strip, box(ego.xy, ego.yaw, LENGTH, WIDTH))

        def over(frac, q=q):
            a, b = (seen_from_line(tail(e, frac), sit, q) for e in (old, ego))
            if not (a[0] < 0 <= b[0] and np.cos(ego.yaw - sit.stop_yaw[q]) > 0):
                return False
            lateral = a[1] + a[0] / (a[0] - b[0]) * (b[1] - a[1])
            return abs(lateral) <= 5 * sit.stop_width[q]

        new = over(0.8) and not memory["passed"][q]
        memory["passed"][q] |= new
        ran["red_light"] |= new and sit.stop_kind[q] == LIGHT and sit.stop_light[q] == RED
        ran["stop_sign"] |= sit.stop_kind[q] == SIGN and over(0.0) and not memory["honoured"][q]
    return ran


def common(memory, old, ego, sit, time_limit):
    """Progress, time and stop lines: what all rewards keep."""
    gained = max(sit.route_s - memory["s"], 0.0)
    memory["s"] += gained
    memory["stood"] = memory["stood"] + DT if ego.speed < 0.1 else 0.0
    memory["steps"] += 1
    timeout = memory["steps"] * DT > time_limit + DT / 2
    return gained, timeout, at_lines(memory, old, ego, sit)


def lanes(ego, sit, reach=None):
    """Whether the ego is outside its lanes; nuPlan's way where a reach is given."""
    edge = sit.lane_width / 2 + (0.5 if reach is None else 0.0)
    outside = abs(sit.lane_lateral) > edge and not (reach is None and sit.on_parking)
    turned = abs(wrapped(sit.lane_yaw - ego.yaw)) >= np.radians(120)
    outside |= turned and not sit.lane_in_junction
    return outside or (reach is not None and abs(sit.route_lateral) > reach)


def speeding(ego, sit):
    return 1 - np.clip((ego.speed - sit.speed_limit) / (8 / 3.6), 0, 1)


def carl(memory, old, ego, agents, sit, time_limit=1200.0):
    gained, _, ran = common(memory, old, ego, sit, time_limit)
    memory["far"] += gained if sit.route_distance > 15 else 0
    ends = {
        "collision": touches(ego, agents),
        "off_road": sit.off_road_frac > 0.95,
        **ran,
        "route_deviation": sit.route_distance >= 30 or memory["far"] > 0.3 * sit.route_length,
        "blocked": memory["stood"] > 90 + DT / 2,
    }
    memory["ttc"] = 500 if meets_soon(ego, agents, 0.1) else max(memory["ttc"] - 1, 0)
    bad = rough(memory, ego, CARLA)
    memory["comfort"] = np.where(bad, 500, np.maximum(memory["comfort"] - 1, 0))
    off_centre = min(abs(sit.lane_lateral) / (sit.lane_width / 2), 1)
    soft = {
        "outside_lanes": 0.0 if lanes(ego, sit) else 1.0,
        "lane": 1.0 if sit.lane_in_junction else 1 - off_centre,
        "speed_limit": speeding(ego, sit),
        "ttc": 0.5 if memory["ttc"] else 1.0,
        "comfort": 1 - 0.5 * (memory["comfort"] > 0).sum() / 6,
    }
    price = 1.0 if ends["collision"] or ends["red_light"] else 0.0
    paid = 100 * gained / sit.route_length * np.prod(list(soft.values())) - price
    return paid, ends, soft


def nuplan(memory, old, ego, agents, sit, mode, time_limit=1200.0):
    gained, timeout, _ = common(memory, old, ego, sit, time_limit)
    ends = {
        "collision": touches(ego, agents) and ego.speed >= 0.05,
        "off_road": bool(sit.corner_off_road.any()),
    }
    fails = any(ends.values())
    memory["ttc"] = memory["ttc"] or meets_soon(ego, agents, 0.005)
    memory["comfort"] = (memory["comfort"] > 0) | rough(memory, ego, NUPLAN)
    x = np.clip((abs(sit.lane_lateral) - 0.5) / (sit.lane_width / 2 - 0.5), 0, 1)
    soft = {
        "outside_lanes": 0.0 if lanes(ego, sit, 5.25) else 1.0,
        "lane": 1.0 if sit.lane_in_junction else 1 - x,
        "speed_limit": speeding(ego, sit),
        "ttc": 0.5 if memory["ttc"] else 1.0,
        "comfort": 1 - 0.5 * memory["comfort"].sum() / 6,
    }
    rho = 0.0 if fails else gained / sit.route_length
    price = 1.0 if ends["collision"] else 0.0
    regular = 100 * rho * np.prod(list(soft.values())) - price
    lives = 0.0 if fails or timeout else 1.0
    num = time_limit / DT
    if mode == "regular":
        paid = regular
    elif mode == "survival":
        paid = 0.4 * regular + 0.6 * 100 / num * lives
    else:
        soft |= {"ttc": float(not memory["ttc"]), "comfort": float(not memory["comfort"].any())}
        kept = (5 * soft["ttc"] + 4 * soft["speed_limit"] + 2 * soft["comfort"]) / num * lives
        paid = 100 * soft["outside_lanes"] * soft["lane"] * (5 * rho + kept) / 16 - price
    return paid, ends, soft


def polar(ego, xy):
    d = xy - ego.xy
    return np.hypot(*d), abs(wrapped(np.arctan2(d[1], d[0]) - ego.yaw))


def signs(memory, ego, sit, reach):
    for q in range(len(sit.stop_kind)):
        near = abs(sit.stop_s[q] - sit.route_s) <= reach
        ahead = seen_from_line(ego.xy, sit, q)[0] < 0
        if sit.stop_kind[q] == SIGN and near and ahead and not memory["honoured"][q]:
            yield np.hypot(*(sit.stop_xy[q] - ego.xy))


def closed_lights(ego, sit, colours, frac, reach):
    for q in range(len(sit.stop_kind)):
        at = seen_from_line(tail(ego, frac), sit, q)
        counts = sit.stop_kind[q] == LIGHT and sit.stop_light[q] in colours and at[0] < 0
        counts &= np.hypot(*at) <= reach and abs(sit.stop_s[q] - sit.route_s) <= 30
        if counts and np.cos(ego.yaw - sit.stop_yaw[q]) > 0:
            yield np.hypot(*(sit.stop_xy[q] - ego.xy))


def roach_speed(memory, ego, agents, sit):
    wanted = [6.0]
    for i in range(len(agents.kind)):
        d, angle = polar(ego, agents.xy[i])
        if d > 9.5 or abs(agents.z[i] - ego.z) >= 3:
            continue
        turned = abs(wrapped(agents.yaw[i] - ego.yaw))
        if agents.kind[i] == VEHICLE and angle < np.pi / 4 and turned <= np.radians(150):
            wanted.append(6 * np.clip(d - 8, 0, 5) / 5)
        cone = np.radians(162 / (np.clip(d, 1.5, 10.5) + 0.3))
        if agents.kind[i] == PEDESTRIAN and angle < cone and sit.others.on_road[i]:
            wanted.append(6 * np.clip(d - 6, 0, 5) / 5)
    for d in closed_lights(ego, sit, (YELLOW, RED), 0.8, 18):
        wanted.append(6 * np.clip(d - 5, 0, 5) / 5)
    for d in signs(memory, ego, sit, 20):
        wanted.append(6 * np.clip(d - 5, 0, 5) / 5)
    return min(wanted)


def roach(memory, old, ego, agents, sit, time_limit=1200.0):
    _, _, ran = common(memory, old, ego, sit, time_limit)
    far = abs(sit.route_lateral)
    limit = max(3.5, memory["lateral"])
    if abs(far - memory["lateral"]) > 0.8:
        limit = far + 0.5
    memory["lateral"] = far
    ends = {
        "collision": touches(ego, agents),
        "pedestrian_overlap": touches(ego, agents, 2.0, 1.6, (PEDESTRIAN,)),
        **ran,
        "lateral_distance": far > limit + 0.01,
        "blocked": memory["stood"] > 90 + DT / 2,
    }
    terms = {
        "speed": 1 - abs(ego.speed - roach_speed(memory, ego, agents, sit)) / 6,
        "position": -far / 2,
        "rotation": -abs(wrapped(ego.yaw - sit.route_yaw)),
        "action": -0.1 if abs(ego.steer - old.steer) > 0.01 else 0.0,
    }
    violation = any(ends[n] for n in ("collision", "pedestrian_overlap", "red_light", "stop_sign"))
    price = float(any(ends.values())) + (ego.speed if violation else 0.0)
    return sum(terms.values()) - price, ends, terms


def think2drive_speed(memory, ego, agents, sit):
    top = 0.8 * sit.speed_limit
    wanted = [top]
    for i in np.flatnonzero(agents.kind == VEHICLE):
        if abs(agents.z[i] - ego.z) < 3:
            wanted.append(top * np.clip(sit.others.route_gap[i] - 8, 0, 12.5) / 12.5)
    for d in closed_lights(ego, sit, (RED,), 0.0, 30):
        wanted.append(top * np.clip(d - 4, 0, 12.5) / 12.5)
    for d in signs(memory, ego, sit, 30):
        wanted.append(top * np.clip(d - 2.5, 0, 12.5) / 12.5)
    return min(wanted)


def think2drive(memory, old, ego, agents, sit, time_limit=1200.0):
    _, _, ran = common(memory, old, ego, sit, time_limit)
    ends = {
        "collision": touches(ego, agents),
        **ran,
        "route_deviation": sit.route_distance > 15,
        "blocked": memory["stood"] > 100 + DT / 2,
    }
    terms = {
        "speed": 1 - abs(ego.speed - think2drive_speed(memory, ego, agents, sit)) / 7.5,
        "travel": np.hypot(*(ego.xy - old.xy)),
        "deviation": -2 * abs(sit.route_lateral) / 8,
        "steer": -0.05 if abs(ego.steer - old.steer) > 0.01 else 0.0,
    }
    paid = sum(terms.values())
    if ends["collision"] or ends["red_light"] or ends["stop_sign"]:
        paid = -1 - ego.speed
    elif ends["route_deviation"]:
        paid = -1.0
    elif sit.route_length - sit.route_s <= 10:
        paid = 1.0
    return paid, ends, terms
