"""Whole places: a furnished room, a table with objects, a garden path; each with the way along
which somebody carries a camera.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64
from alpasim_plugin.gaussians.scene.scene_graph import Level, SceneGraph, SceneNode, nodes_by_tile
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky, make_sky
from alpasim_plugin.lab.interiors import furniture as f
from alpasim_plugin.lab.interiors.garden import daylight, garden_things
from alpasim_plugin.lab.interiors.light import Lamp, Light
from alpasim_plugin.lab.interiors.materials import Paint, Rng, plain, planks, stripes, tiles
from alpasim_plugin.lab.interiors.objects import OBJECTS
from alpasim_plugin.lab.interiors.surfaces import Block, Panel, Surfels, Thing, upright

# half the side of the square in the middle of a room that furniture along the walls leaves free
MIDDLE_M = 0.8
CELL_PX = 2.5  # cells stay below so many pixels; things are nearer than in a street
WALL_CELLS_M, THING_CELLS_M, SMALL_CELLS_M = (
    (0.02, 0.05),
    (0.014, 0.035),
    (0.006, 0.015),
)  # levels of detail
GARDEN_CELLS_M, LAWN_CELLS_M = (0.022, 0.06), (0.08, 0.2)
WALL_TILE_M, LAWN_TILE_M = 1.0, 5.0  # of what is culled as one


@dataclass(frozen=True)
class Walk:
    """The way of a camera: places of the eye and of what it looks at, both ``(K, 3)``, metres,
    evenly spaced in time.
    """

    eye: F64
    target: F64


@dataclass(frozen=True)
class Place:
    """A place ready to be rendered from the eyes of its walk.

    Attributes:
        graph: Its Gaussians.
        walk: The camera's way.
    """

    graph: SceneGraph
    walk: Walk


@dataclass(frozen=True)
class Standing:
    """A thing, where it stands, and how finely it is covered."""

    name: str
    thing: Thing
    T: F64
    cells_m: tuple[float, float] = THING_CELLS_M

    def blocks(self) -> tuple[Block, ...]:
        """Return its shadow throwers in the world."""
        return tuple(Block(self.T @ b.T, b.half) for b in self.thing.blocks)

    def footprint(self) -> tuple[F64, F64]:
        """Return low and high corner ``(2,)`` of its blocks, plan."""
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        corners = np.concatenate(
            [(signs * b.half) @ b.T[:3, :3].T + b.T[:3, 3] for b in self.blocks()]
        )[:, :2]
        return corners.min(axis=0), corners.max(axis=0)


@dataclass(frozen=True)
class Plan:
    """What stands where in which light, before it is covered with surfels."""

    standing: tuple[Standing, ...]
    light: Light
    sky: Sky
    walk: Walk


def build_place(family: str, scene_id: str, seed: int, coarseness: float = 1.0) -> Place:
    """Build a place; the same family, name and seed give bit-identical Gaussians.

    Args:
        family: ``room``, ``table`` or ``path``.
        scene_id, seed: Key of the random streams.
        coarseness: By what the size of surfels is multiplied; the place stays the same.

    Raises:
        KeyError: No such family.
    """
    plan = FAMILIES[family](stream(scene_id, seed, f"interior.{family}"))
    return Place(_assembled(plan.standing, plan.light, plan.sky, coarseness), plan.walk)


def _assembled(
    standing: Sequence[Standing], light: Light, sky: Sky, coarseness: float
) -> SceneGraph:
    """Light everything and cut what is large into tiles."""
    blocks = [one.blocks() for one in standing]
    nodes: list[SceneNode] = []
    for i, one in enumerate(standing):
        others = [b for k, many in enumerate(blocks) if k != i for b in many]
        levels = []
        for cell_m in one.cells_m:
            surfels: Surfels = one.thing.surfels(coarseness * cell_m).moved(one.T)
            cloud = surfels.cloud(light.colours(surfels, others))
            tile = np.floor(
                surfels.means / (LAWN_TILE_M if one.cells_m == LAWN_CELLS_M else WALL_TILE_M)
            ).astype(np.int64) @ np.array([1, 1_009, 1_018_081])
            levels.append((coarseness * cell_m, cloud, tile))
        if one.cells_m in (WALL_CELLS_M, LAWN_CELLS_M):
            nodes += nodes_by_tile(one.name, levels)
        else:
            nodes.append(
                SceneNode(
                    one.name,
                    "background",
                    tuple(Level(cell_m, cloud) for cell_m, cloud, _ in levels),
                )
            )
    return SceneGraph(nodes, [], sky, cell_px=CELL_PX)


def _no_sky() -> Sky:
    return Sky(np.zeros((HEIGHT, WIDTH, 3), np.float32))


def _floor_paint(rng: Rng) -> Paint:
    kind = int(rng.integers(4))
    if kind < 2:
        return planks(
            rng,
            f.chosen(rng, f.WOODS[:4]),
            float(rng.uniform(0.08, 0.18)),
            float(rng.uniform(0.8, 1.8)),
        )
    if kind == 2:
        tone = rng.uniform(0.45, 0.8) * np.array([1.0, 0.97, 0.92])
        return tiles(
            rng, tone, tone * (1.0 if rng.random() < 0.5 else 0.55), float(rng.uniform(0.2, 0.4))
        )
    return plain(rng, f.chosen(rng, f.CLOTHS), 0.10)


def _wall_paint(rng: Rng) -> Paint:
    base = rng.uniform(0.62, 0.88) * np.array([1.0, rng.uniform(0.9, 1.0), rng.uniform(0.78, 1.0)])
    upper = (
        stripes(rng, base, 0.9 * base, float(rng.uniform(0.1, 0.3)))
        if rng.random() < 0.4
        else plain(rng, base, 0.02)
    )
    skirting = rng.uniform(0.35, 0.95) * np.array([1.0, 0.98, 0.94])
    return lambda x, y: np.where(
        (y < 0.10)[:, None],
        skirting * np.where(np.abs(y - 0.093) < 0.007, 0.6, 1.0)[:, None],
        upper(x, y),
    )


def _shell(rng: Rng, w: float, d: float, h: float) -> Standing:
    """Return floor, ceiling and the four walls of a room around the origin."""
    wall = _wall_paint(rng)
    x = w / 2
    y = d / 2
    sides = [((-x, y), (w, 0)), ((x, y), (0, -d)), ((x, -y), (-w, 0)), ((-x, -y), (0, d))]
    parts = [Panel((*corner, 0.0), (*edge, 0.0), (0, 0, h), wall) for corner, edge in sides]
    parts.append(Panel((-x, -y, 0), (w, 0, 0), (0, d, 0), _floor_paint(rng)))
    parts.append(Panel((-x, y, h), (w, 0, 0), (0, -d, 0), plain(rng, (0.86, 0.85, 0.83), 0.015)))
    return Standing("shell", Thing(tuple(parts)), np.eye(4), WALL_CELLS_M)


def _room_light(rng: Rng, w: float, d: float, h: float, window_at: F64 | None) -> Light:
    spread = np.array([[0.25, 0.1, 0], [-0.2, 0.2, 0], [0.05, -0.25, 0]])
    warm = np.array([1.0, rng.uniform(0.86, 0.97), rng.uniform(0.7, 0.92)])
    lamps = [
        Lamp(
            np.array([rng.uniform(-0.2, 0.2) * w, rng.uniform(-0.2, 0.2) * d, h - 0.12]) + spread,
            0.55 * warm,
            3.5,
        )
    ]
    if window_at is not None:
        lamps.append(
            Lamp(window_at + spread[:2], np.array([0.80, 0.85, 0.92]) * rng.uniform(0.5, 0.9), 3.0)
        )
    corner = np.array([w / 2, d / 2, h])
    return Light(
        rng.uniform(0.42, 0.55) * np.array([1.0, 0.98, 0.96]),
        tuple(lamps),
        (np.array([-w / 2, -d / 2, 0.0]), corner),
    )


WALL_FURNITURE: tuple[Callable[[Rng], Thing], ...] = (
    f.shelf,
    f.cupboard,
    f.sofa,
    f.bed,
    f.table,
    f.plant,
    f.lamp,
    f.chair,
)


def _along_walls(rng: Rng, w: float, d: float, h: float) -> tuple[list[Standing], F64 | None]:
    """Furnish the four walls; returns what stands and hangs there, and the middle of a window."""
    standing: list[Standing] = []
    window_at = None
    walls = [
        (0.0, w, d / 2),
        (-np.pi / 2, d, w / 2),
        (np.pi, w, d / 2),
        (np.pi / 2, d, w / 2),
    ]  # yaw, length, distance from the middle
    order = rng.permutation(len(WALL_FURNITURE))
    kinds = [WALL_FURNITURE[i] for i in order] * 2
    opening = int(rng.integers(4))
    for side, (yaw, length, distance) in enumerate(walls):
        turn = upright(0, 0, 0, yaw)
        at = -length / 2 + 0.35
        while at < length / 2 - 0.4 and kinds:
            thing = kinds.pop()(rng)
            low, high = _extent(thing)
            width = float(high[0] - low[0])
            if at + width > length / 2 - 0.35 or _taken(
                standing, turn, at, width, distance, float(high[1] - low[1])
            ):
                at += 0.4
                continue
            T = turn @ upright(at - float(low[0]), distance - float(high[1]) - 0.03)
            standing.append(Standing(f"wall{side}/{len(standing)}", thing, T))
            at += width + float(rng.uniform(0.1, 0.7))
        if side == opening or rng.random() < 0.3:
            size = (float(rng.uniform(1.0, 1.5)), 1.15)
            T = turn @ upright(float(rng.uniform(-0.2, 0.2)) * length, distance)
            standing.append(Standing(f"window{side}", f.on_wall(rng, "window", size, 1.0), T))
            window_at = np.asarray(T @ [0.0, -0.4, 1.6, 1.0])[:3]
            continue
        for k in range(int(rng.integers(1, 4))):
            size = (float(rng.uniform(0.35, 0.9)), float(rng.uniform(0.35, 0.6)))
            T = turn @ upright((k - 1) * 1.2 + float(rng.uniform(-0.15, 0.15)), distance)
            if abs((k - 1) * 1.2) + 0.7 < length / 2:
                standing.append(
                    Standing(
                        f"picture{side}/{k}",
                        f.on_wall(rng, "picture", size, float(rng.uniform(1.35, 1.6))),
                        T,
                    )
                )
    return standing, window_at


def _extent(thing: Thing) -> tuple[F64, F64]:
    return Standing("", thing, np.eye(4)).footprint()


def _taken(
    standing: Sequence[Standing], turn: F64, at: float, width: float, distance: float, depth: float
) -> bool:
    """Return whether this one would stand in the middle of the room, or where furniture of another
    wall stands.
    """
    ends = turn @ np.array([[at, distance, 0, 1], [at + width, distance - depth - 0.05, 0, 1]]).T
    low, high = ends[:2].min(axis=1), ends[:2].max(axis=1)
    if np.all(low < MIDDLE_M) and np.all(high > -MIDDLE_M):
        return True
    feet = [one.footprint() for one in standing if one.thing.blocks]
    return any(bool(np.all(a < high) and np.all(b > low)) for a, b in feet)


def _room(rng: Rng) -> Plan:
    """Return a furnished room and a walk through its middle, past the furniture."""
    w, d, h = (float(v) for v in rng.uniform((4.4, 3.8, 2.4), (6.2, 5.2, 2.8)))
    standing, window_at = _along_walls(rng, w, d, h)
    middle = Standing(
        "middle",
        f.low_table(rng) if rng.random() < 0.6 else f.table(rng),
        upright(0, 0, 0, float(rng.uniform(0, np.pi))),
    )
    rug_T = upright(0, 0, 0, float(rng.uniform(-0.2, 0.2)))
    standing += [
        middle,
        Standing(
            "rug",
            f.carpet(rng, (float(rng.uniform(1.8, 2.4)), float(rng.uniform(1.3, 1.8)))),
            rug_T,
        ),
    ]
    standing += _objects(rng, middle, 3)
    shell, light = _shell(rng, w, d, h), _room_light(rng, w, d, h, window_at)
    start, sweep = (
        float(rng.uniform(0, 2 * np.pi)),
        float(rng.uniform(0.9, 1.5)) * (1 if rng.random() < 0.5 else -1),
    )
    s = np.linspace(0, 1, 9)
    turn = start + sweep * s
    radius = np.array([0.5 * w - 1.15, 0.5 * d - 1.15])
    eye = np.column_stack(
        [np.column_stack([np.cos(turn), np.sin(turn)]) * radius, np.full(9, rng.uniform(1.35, 1.6))]
    )
    across = turn + np.pi + rng.uniform(-0.5, 0.5) * np.sin(np.pi * s)
    target = np.column_stack(
        [0.5 * w * np.cos(across), 0.5 * d * np.sin(across), np.full(9, rng.uniform(0.7, 1.0))]
    )
    return Plan((shell, *standing), light, _no_sky(), Walk(eye, target))


def _objects(rng: Rng, table: Standing, count: int) -> list[Standing]:
    """Return objects on a table, apart from each other."""
    low, high = _extent(table.thing)
    top = max(float(b.T[2, 3] + b.half[2]) for b in table.thing.blocks)
    out: list[Standing] = []
    taken: list[tuple[F64, float]] = []
    for k in range(40):
        if len(out) == count:
            break
        thing = OBJECTS[int(rng.integers(len(OBJECTS)))](rng)
        a, b = _extent(thing)
        radius = float(np.hypot(*np.maximum(np.abs(a), np.abs(b)))) + 0.02
        at = rng.uniform(low + radius, np.maximum(high - radius, low + radius))
        if all(np.linalg.norm(at - other) > radius + r for other, r in taken):
            taken.append((at, radius))
            T = table.T @ upright(float(at[0]), float(at[1]), top, float(rng.uniform(0, 2 * np.pi)))
            out.append(Standing(f"object{k}", thing, T, SMALL_CELLS_M))
    return out


def _table(rng: Rng) -> Plan:
    """Return a table full of objects in a room and a walk half around it."""
    w, d, h = (float(v) for v in rng.uniform((3.8, 3.6, 2.4), (5.0, 4.6, 2.7)))
    standing, window_at = _along_walls(rng, w, d, h)
    table = Standing(
        "table",
        f.table(rng, (float(rng.uniform(1.0, 1.4)), float(rng.uniform(0.8, 1.0)))),
        upright(0, 0, 0, float(rng.uniform(0, np.pi))),
    )
    objects = _objects(rng, table, int(rng.integers(7, 11)))
    shell, light = _shell(rng, w, d, h), _room_light(rng, w, d, h, window_at)
    s = np.linspace(0, 1, 9)
    turn = float(rng.uniform(0, 2 * np.pi)) + float(rng.uniform(1.2, 2.2)) * s * (
        1 if rng.random() < 0.5 else -1
    )
    away = float(rng.uniform(1.0, 1.2)) + 0.1 * np.sin(2 * np.pi * s + float(rng.uniform(0, 6)))
    eye = np.column_stack(
        [away * np.cos(turn), away * np.sin(turn), np.full(9, rng.uniform(1.2, 1.45))]
    )
    target = np.column_stack([0.1 * np.cos(turn + 2), 0.1 * np.sin(turn + 2), np.full(9, 0.78)])
    return Plan((shell, *standing, table, *objects), light, _no_sky(), Walk(eye, target))


def _path(rng: Rng) -> Plan:
    """Return a garden path with hedges, trees and a house, and a walk along it."""
    bend, length = float(rng.uniform(-0.05, 0.05)), 16.0
    cells = {"ground": WALL_CELLS_M, "lawn": LAWN_CELLS_M}
    standing = [
        Standing(name, thing, T, cells.get(name, GARDEN_CELLS_M))
        for name, thing, T in garden_things(rng, bend, length)
    ]
    light, sky = daylight(rng), make_sky("clear" if rng.random() < 0.6 else "overcast", rng)
    s = np.linspace(0, 1, 9)
    x = 1.0 + float(rng.uniform(4.5, 6.5)) * s
    side = float(rng.uniform(-0.2, 0.2)) + bend * x**2
    eye = np.column_stack([x, side, np.full(9, rng.uniform(1.45, 1.65))])
    swing = float(rng.uniform(0.3, 1.2)) * np.sin(2 * np.pi * (0.7 * s + rng.random()))
    target = np.column_stack(
        [x + 4.0, bend * (x + 4.0) ** 2 + swing, np.full(9, rng.uniform(0.8, 1.2))]
    )
    return Plan(tuple(standing), light, sky, Walk(eye, target))


FAMILIES: Mapping[str, Callable[[Rng], Plan]] = {"room": _room, "table": _table, "path": _path}
