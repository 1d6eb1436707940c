"""Small OpenDRIVE files for the tests, put together from strings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence


def geometry(shape: str, length: float, x=0.0, y=0.0, hdg=0.0, s=0.0) -> str:
    """One planView piece; `shape` is its inner element."""
    place = f'x="{x!r}" y="{y!r}" hdg="{hdg!r}"'
    return f'<geometry s="{s!r}" {place} length="{length!r}">{shape}</geometry>'


def cubic(tag: str, start: float, a=0.0, b=0.0, c=0.0, d=0.0, key="s") -> str:
    """A record of a + b ds + c ds^2 + d ds^3."""
    return f'<{tag} {key}="{start!r}" a="{a!r}" b="{b!r}" c="{c!r}" d="{d!r}"/>'


def width(a: float, b=0.0, c=0.0, d=0.0, start=0.0, tag="width") -> str:
    """A lane's width (or border) record."""
    return cubic(tag, start, a, b, c, d, key="sOffset")


def lane(
    lane_id: int,
    widths: str | None = None,
    pred: int | Sequence[int] = (),
    succ: int | Sequence[int] = (),
    kind: str = "driving",
    inner: str = "",
    attributes: str = "",
) -> tuple[int, str]:
    """A lane with its id; 3.5 m wide unless said otherwise."""
    ids = [("predecessor", pred), ("successor", succ)]
    links = "".join(
        f'<{tag} id="{i}"/>'
        for tag, which in ids
        for i in ((which,) if isinstance(which, int) else which)
    )
    shape = (width(3.5) if widths is None else widths) if lane_id else ""
    return lane_id, (
        f'<lane id="{lane_id}" type="{kind}" level="false" {attributes}><link>{links}</link>'
        f"{shape}{inner}</lane>"
    )


def section(lanes: Iterable[tuple[int, str]], s=0.0) -> str:
    """A lane section; the middle lane is added if missing."""
    lanes = dict(lanes)
    lanes.setdefault(0, lane(0, kind="none")[1])
    out = f'<laneSection s="{s!r}">'
    for side, sign in (("left", 1), ("center", 0), ("right", -1)):
        texts = [t for i, t in sorted(lanes.items(), reverse=True) if (i > 0) - (i < 0) == sign]
        out += f"<{side}>{''.join(texts)}</{side}>" if texts else ""
    return out + "</laneSection>"


def link(tag: str, target: object, contact: str | None = None, kind: str = "road") -> str:
    """A road's predecessor or successor."""
    end = f' contactPoint="{contact}"' if contact else ""
    return f'<{tag} elementType="{kind}" elementId="{target}"{end}/>'


def road(
    road_id: object,
    length: float,
    geometries: str | None = None,
    sections: str | None = None,
    links: str = "",
    junction: object = -1,
    rule: str = "",
    offsets: str = "",
    elevation: str = "",
    extra: str = "",
    kind: str = "",
) -> str:
    """A road; straight, with one lane each way, unless said otherwise."""
    geometries = geometries or geometry("<line/>", length)
    sections = sections or section([lane(1), lane(-1)])
    rule = f' rule="{rule}"' if rule else ""
    return (
        f'<road name="" length="{length!r}" id="{road_id}" junction="{junction}"{rule}>'
        f"<link>{links}</link>{kind}<planView>{geometries}</planView>"
        f"<elevationProfile>{elevation}</elevationProfile><lateralProfile/>"
        f"<lanes>{offsets}{sections}</lanes>{extra}</road>"
    )


def document(*parts: str, vendor: str = "test") -> str:
    """The whole file."""
    header = f'<header revMajor="1" revMinor="4" name="" version="1" vendor="{vendor}"/>'
    return f'<?xml version="1.0"?><OpenDRIVE>{header}{"".join(parts)}</OpenDRIVE>'


def junction(junction_id: object, connections: Iterable[tuple], extra: str = "") -> str:
    """A junction of (incoming road, connecting road, contact point, [(from, to), ...])."""
    text = "".join(
        f'<connection id="{i}" incomingRoad="{a}" connectingRoad="{b}" contactPoint="{contact}">'
        + "".join(f'<laneLink from="{x}" to="{y}"/>' for x, y in links)
        + "</connection>"
        for i, (a, b, contact, links) in enumerate(connections)
    )
    return f'<junction id="{junction_id}" name="">{text}{extra}</junction>'


def _two_roads(contact_1: str, contact_2: str) -> str:
    """Road 1 leads on in road 2; each touches the other with the named end, on the x axis."""
    # Road 1 covers x in [0, 30], road 2 x in [30, 60]; an end that touches lies at x = 30.
    ways = {"end": (0.0, 0.0), "start": (30.0, math.pi)}
    x1, hdg1 = ways[contact_1]
    x2, hdg2 = (30.0, 0.0) if contact_2 == "start" else (60.0, math.pi)
    # Equal ids go on in equal ids if an end touches a start, else sides change.
    sign = 1 if contact_1 != contact_2 else -1
    tag_1 = "successor" if contact_1 == "end" else "predecessor"
    tag_2 = "successor" if contact_2 == "end" else "predecessor"
    lanes_1 = [lane(i, **{tag_1[:4]: sign * i}) for i in (2, 1, -1)]
    lanes_2 = [lane(i * sign, **{tag_2[:4]: i}) for i in (2, 1, -1)]
    return document(
        road(
            1,
            30.0,
            geometry("<line/>", 30.0, x1, 0.0, hdg1),
            section(lanes_1),
            link(tag_1, 2, contact_2),
        ),
        road(
            2,
            30.0,
            geometry("<line/>", 30.0, x2, 0.0, hdg2),
            section(lanes_2),
            link(tag_2, 1, contact_1),
        ),
    )


def _spiral() -> str:
    shapes = (
        '<spiral curvStart="0.01" curvEnd="0.09"/>',
        '<spiral curvStart="0.0" curvEnd="-0.05"/>',
    )
    return document(
        road(1, 40.0, geometry(shapes[0], 40.0, 5.0, -3.0, 0.7)),
        road(2, 60.0, geometry(shapes[1], 60.0, 100.0, 0.0, -2.0)),
    )


PARAM = 'aU="0" bU="{bu}" cU="{cu}" dU="{du}" aV="0" bV="0" cV="{cv}" dV="{dv}"'


def curve_length(u: Sequence[float], v: Sequence[float], p_end: float) -> float:
    """Length of the cubic (u(p), v(p)) from 0 to p_end by Simpson's rule with 20,000 steps."""
    n = 20_000
    total = 0.0
    for i in range(n + 1):
        p = p_end * i / n
        du = u[0] + p * (2 * u[1] + p * 3 * u[2])
        dv = v[0] + p * (2 * v[1] + p * 3 * v[2])
        total += math.hypot(du, dv) * (1 if i in (0, n) else 4 if i % 2 else 2)
    return total * p_end / (3 * n)


def _param_poly3() -> str:
    """The same curve twice, 50 m apart: normalized, and (nearly) by arc length."""
    u, v = (30.0, 2.0, -4.0), (0.0, 12.0, -5.0)
    length = curve_length(u, v, 1.0)
    shape = PARAM.format(bu=u[0], cu=u[1], du=u[2], cv=v[1], dv=v[2])
    slow = curve_length((1.0, 0.0, -1e-4), (0.0, 0.01, -1e-5), 25.0)
    other = PARAM.format(bu=1.0, cu=0.0, du=-1e-4, cv=0.01, dv=-1e-5)
    return document(
        road(1, length, geometry(f'<paramPoly3 pRange="normalized" {shape}/>', length, 0, 0, 0.3)),
        road(2, length, geometry(f"<paramPoly3 {shape}/>", length, 0.0, 50.0, 0.3)),
        road(3, slow, geometry(f'<paramPoly3 pRange="arcLength" {other}/>', slow, 0.0, -50.0)),
    )


def _poly3() -> str:
    length = curve_length((1.0, 0.0, 0.0), (0.1, 0.02, -0.0004), 30.0)
    return document(
        road(
            1, length, geometry('<poly3 a="0.5" b="0.1" c="0.02" d="-0.0004"/>', length, 1, 2, 1.0)
        )
    )


def _sections() -> str:
    """Lane ids that change across sections, widths and offsets that grow, lanes that end."""
    return document(
        road(
            1,
            60.0,
            geometry('<arc curvature="0.02"/>', 60.0, 0.0, 0.0, 0.2),
            section([lane(1, succ=1), lane(-1, succ=-2), lane(-2, succ=-4)])
            + section(
                [
                    lane(1, pred=1, succ=2),
                    lane(-1, width(0.0, 0.0, 0.026, -0.0009), succ=-1),
                    lane(-2, pred=-1, succ=-2),
                    lane(-3, width(1.0), kind="median"),
                    lane(-4, pred=-2, succ=-4),
                ],
                s=20.0,
            )
            + section(
                [
                    lane(2, width(3.0, 0.01), pred=1),
                    lane(1, width(2.0), kind="shoulder"),
                    lane(-1, pred=-1),
                    lane(-2, pred=-2),
                    lane(-3, width(0.5), kind="none"),
                    lane(-4, pred=-4),
                ],
                s=40.0,
            ),
            offsets=cubic("laneOffset", 0.0, 0.5, 0.02)
            + cubic("laneOffset", 30.0, 1.1, 0.0, -0.001),
        )
    )


def _crossing() -> str:
    """Three arms and a junction with one two-lane connection and one per other way."""
    half = 20.0
    arms = [
        road(i, 50.0, geometry("<line/>", 50.0, x, y, h), section([lane(1), lane(-1)]),
             link("predecessor", 100, kind="junction"))
        for i, x, y, h in ((1, half, 0.0, 0.0), (2, 0.0, half, math.pi / 2), (3, -half, 0.0,
        math.pi))
    ]  # fmt: skip
    arms[0] = road(
        1, 50.0, geometry("<line/>", 50.0, half, 0.0, 0.0), section([lane(2), lane(1), lane(-1)]),
        link("predecessor", 100, kind="junction"),
    )  # fmt: skip
    quarter = math.pi / 2 * half
    straight = section([lane(-1, pred=1, succ=-1), lane(-2, pred=2)])
    turn = section([lane(-1, pred=1, succ=-1)])
    ways = [
        # straight on, from arm 1 (lanes 1 and 2) to arm 3, along s
        road(11, 2 * half, geometry("<line/>", 2 * half, half, 0.0, math.pi), straight,
             link("predecessor", 1, "start") + link("successor", 3, "start"), 100),
        # from arm 2 to arm 1: a left turn about (20, 20)
        road(12, quarter, geometry('<arc curvature="0.05"/>', quarter, 0.0, half, -math.pi / 2),
             turn, link("predecessor", 2, "start") + link("successor", 1, "start"), 100),
        # from arm 3 to arm 2, drawn against the traffic: lane 1, entered at the road's end
        road(13, quarter, geometry('<arc curvature="-0.05"/>', quarter, 0.0, half, -math.pi / 2),
             section([lane(1, pred=-1, succ=1)]),
             link("predecessor", 2, "start") + link("successor", 3, "start"), 100),
    ]  # fmt: skip
    return document(
        *arms,
        *ways,
        junction(
            100,
            [
                (1, 11, "start", [(1, -1), (2, -2)]),
                (2, 12, "start", [(1, -1)]),
                (3, 13, "end", [(1, 1)]),
            ],
        ),
    )


def _left_hand() -> str:
    lanes = [lane(1, succ=1), lane(-1, succ=-1)], [lane(1, pred=1), lane(-1, pred=-1)]
    sections = section(lanes[0]) + section(lanes[1], s=12.0)
    return document(road(1, 30.0, sections=sections, rule="LHT"))


def _kinds() -> str:
    kinds = (
        "driving entry exit onRamp offRamp connectingRamp slipLane bidirectional parking".split()
    )
    lanes = [lane(-1 - i, kind=kind) for i, kind in enumerate(kinds)]
    return document(road(1, 20.0, sections=section(lanes)))


FILES = {
    "spiral": _spiral(),
    "paramPoly3": _param_poly3(),
    "poly3": _poly3(),
    "sections": _sections(),
    "crossing": _crossing(),
    "left_hand": _left_hand(),
    "kinds": _kinds(),
} | {f"contact_{a}_{b}": _two_roads(a, b) for a in ("end", "start") for b in ("start", "end")}
