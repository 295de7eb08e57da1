"""Build what stands beside the road: kerbs or guard rails, trees, lamp poles, signs."""

from typing import NamedTuple

import numpy as np

from alpasim_plugin.core.detail import halvings
from alpasim_plugin.core.geometry import arc_lengths, left_of, resample, unit
from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.scene.scene_graph import SceneNode, nodes_by_tile, tile_numbers
from alpasim_plugin.streets.build_facades import DEPTH_M, Houses
from alpasim_plugin.streets.build_road import KERB_M
from alpasim_plugin.streets.site import (
    CELL_M,
    TILE_M,
    Roadside,
    Site,
    contours,
    places,
)
from alpasim_plugin.streets.surfels import (
    IDENTITY,
    SPREAD,
    cell_counts,
    cloud_of,
    quad_surfels,
    quats_along,
    rods,
)

KERB_WIDTH_M = 0.16
KERB_RGB = (0.66, 0.65, 0.62)
RAIL_RGB = (0.62, 0.64, 0.66)
POST_RGB = (0.45, 0.46, 0.47)
POLE_RGB = (0.36, 0.38, 0.38)
TRUNK_RGB = (0.30, 0.24, 0.19)
# Distance of street trees from the road's edge, by highway or not.
TREE_LINE_M = {False: 1.6, True: 7.0}
RIM_RGB = (0.88, 0.88, 0.86)
SIGN_RGB = ((0.75, 0.12, 0.10), (0.10, 0.28, 0.62), (0.88, 0.72, 0.12), (0.10, 0.42, 0.26))
LEAVES = np.array([[0.24, 0.38, 0.15], [0.30, 0.43, 0.18], [0.20, 0.33, 0.17], [0.38, 0.43, 0.17]])
USUAL_CELL_M = {"kerb": 0.25, "sign": 0.12}  # sharp cameras see halves of them
Item = tuple[float, GaussianCloud, F64]  # cell size, cloud, plan position of each Gaussian's owner


def build_street(site: Site, houses: Houses) -> list[SceneNode]:
    """Return the nodes of everything beside the road but the houses."""
    edge = ("guard-rail", _rails(site)) if site.highway else ("kerb", _kerbs(site))
    parts = [edge, ("tree", _trees(site, houses)), ("pole", _poles(site, houses))]
    nodes = []
    for name, items in [*parts, ("sign", _signs(site))]:
        levels = []
        for cell_m, cloud, cell_places in items:
            owned = site.owns(cell_places)
            if owned.any():
                tile = tile_numbers(cell_places[owned] - site.low, TILE_M)
                levels.append((cell_m, cloud.take(owned), tile))
        nodes += nodes_by_tile(name, levels, usual_cell_m=USUAL_CELL_M.get(name, 0.0))
    return nodes


def _spots(site: Site, beyond_m: float, step_m: float, shortest_m: float) -> Roadside | None:
    """Return places every ``step_m`` along the road's edge; None where it is too short for one."""
    lines = contours(site, beyond_m, 60.0)
    spots = [
        places(line, step_m, step_m / 2) for line in lines if arc_lengths(line)[-1] > shortest_m
    ]
    if not spots:
        return None
    return Roadside(*(np.concatenate(column) for column in zip(*spots, strict=True)))


def _kerbs(site: Site) -> list[Item]:
    """Place a kerb along the road's edge: a face towards the road and a top."""
    items = []
    usual_m = USUAL_CELL_M["kerb"]
    finer = [(usual_m / 2**n, 0.5 / 2**n, 2**n + 1) for n in halvings(site.scenario)]
    for cell_m, step, rows in (*finer, (usual_m, 0.5, 1), (0.7, 1.0, 1), (1.6, 2.0, 1)):
        spots = _spots(site, 0.0, step, 2 * step)
        if spots is None:
            return []
        n = len(spots.xy)
        rgb = np.array(KERB_RGB) * (1 + 0.03 * site.rng(f"kerb-{step}").standard_normal((n, 1)))
        quats = quats_along(site.frame.turned(spots.along))
        # Contours run through the centres of the first cells off the road: half a cell behind the
        # edge.
        xy = spots.xy - 0.5 * CELL_M * spots.away
        clouds = [
            cloud_of(
                site.world(xy + back_m * spots.away, above_m),
                quats,
                (SPREAD * step, *size),
                shade * rgb,
            )
            for back_m, above_m, size, shade in _kerb_rows(rows)
        ]
        items.append((cell_m, GaussianCloud.concatenate(clouds), np.tile(xy, (len(clouds), 1))))
    return items


def _kerb_rows(count: int) -> list[tuple[float, float, tuple[float, float], float]]:
    """Return the rows of Gaussians of a kerb's face and top: how far behind the edge and above the
    road, deviations across, shade.
    """
    if count == 1:
        return [(0.0, 0.4 * KERB_M, (0.05, 0.08), 0.80), (0.08, KERB_M, (0.09, 0.015), 1.05)]
    middles = (np.arange(count) + 0.5) / count
    face = SPREAD * KERB_M / count
    top = SPREAD * KERB_WIDTH_M / count
    return [
        *((0.0, middle_m * KERB_M, (0.01, face), 0.80) for middle_m in middles),
        *((middle_m * KERB_WIDTH_M, KERB_M, (top, 0.01), 1.05) for middle_m in middles),
    ]


def _rails(site: Site) -> list[Item]:
    """Place a guard rail along a highway."""
    items = []
    for cell_m, step in ((0.3, 1.0), (0.9, 2.0), (2.0, 4.0)):
        spots = _spots(site, 1.2, step, 8.0)
        if spots is None:
            return []
        xy = spots.xy
        quats = quats_along(site.frame.turned(spots.along))
        clouds = [
            cloud_of(
                site.world(xy, height),
                quats,
                (SPREAD * step, 0.03, 0.05),
                np.array(RAIL_RGB) * shade,
            )
            for height, shade in ((0.56, 0.8), (0.72, 1.0))
        ]
        posts = xy[:: max(1, round(4.0 / step))]
        foot = site.world(posts, 0.0)
        clouds.append(rods(foot, foot + np.array([0, 0, 0.62]), 0.06, POST_RGB, 0.7))
        items.append((cell_m, GaussianCloud.concatenate(clouds), np.concatenate([xy, xy, posts])))
    return items


def _trees(site: Site, houses: Houses) -> list[Item]:
    """Place street trees along the road and woods where there are no houses."""
    per_100m = site.scenario.environment.trees_per_100m
    if per_100m <= 0:
        return []
    rng = site.rng("trees")
    spots = []
    for line in contours(site, TREE_LINE_M[site.highway], 70.0):
        mean = 100.0 / per_100m
        n = int(arc_lengths(line)[-1] / mean)
        s = (np.arange(n) + rng.uniform(0.1, 0.9, n)) * mean
        if n:
            spots.append(resample(line, s))
    street = np.concatenate(spots) if spots else np.zeros((0, 2))
    street = street[_free(site, houses, street, 0.6 if not site.highway else 3.0)]
    h, w = site.road.shape
    n_wood = int(0.00022 * per_100m * h * w * 0.0625)
    wood = site.low + rng.random((n_wood, 2)) * np.array([w, h]) * 0.25
    wood = wood[_free(site, houses, wood, 17.0 if not site.highway else 14.0)]
    places = np.concatenate([street, wood])
    if len(places) == 0:
        return []
    m = len(places)
    crown = rng.uniform(1.5, 2.4, m) * np.where(np.arange(m) < len(street), 1.0, 1.35)
    stem = rng.uniform(2.1, 3.0, m)
    leaf = LEAVES[rng.integers(len(LEAVES), size=m)] * rng.uniform(0.85, 1.15, (m, 1))
    foot = site.world(places, 0.0 if site.highway else KERB_M)
    items = []
    for cell_m, count in ((0.25, 520), (0.36, 170), (0.8, 48), (1.8, 14)):
        crowns, owner = _crowns(site, foot, crown, stem, leaf, count)
        top = foot + np.column_stack([np.zeros(m), np.zeros(m), stem + 0.5 * crown])
        trunks = rods(foot, top, 0.13, TRUNK_RGB, 0.5 if count > 100 else 4.0)
        away = np.linalg.norm(trunks.means[:, None, :2] - foot[None, :, :2], axis=2)
        owners = np.concatenate([owner, np.argmin(away, axis=1)])
        items.append((cell_m, GaussianCloud.concatenate([crowns, trunks]), places[owners]))
    return items


def _crowns(
    site: Site, foot: F64, crown: F64, stem: F64, leaf: F64, count: int
) -> tuple[GaussianCloud, I64]:
    """Fill crowns with ``count`` blobs each, light above and dark below."""
    rng = site.rng(f"crowns-{count}")
    m = len(foot)
    owner = np.repeat(np.arange(m), count)
    direction = rng.standard_normal((m * count, 3))
    direction = unit(direction)
    radius = rng.random(m * count) ** 0.4
    local = direction * radius[:, None] * np.array([1.0, 1.0, 0.95])
    size = crown[owner]
    means = foot[owner] + local * size[:, None]
    means[:, 2] += (stem + 0.85 * crown)[owner]
    light = 0.78 + 0.34 * local[:, 2] + 0.16 * rng.standard_normal(m * count)
    rgb = leaf[owner] * np.clip(light, 0.35, 1.5)[:, None]
    # Coarser levels cover the same crown with fewer, larger blobs.
    blob = size * {520: 0.095, 170: 0.16, 48: 0.25, 14: 0.42}[count]
    scales = np.column_stack([blob, blob, 0.8 * blob]) * rng.uniform(0.7, 1.25, (m * count, 1))
    quats = rng.standard_normal((m * count, 4))
    quats = unit(quats)
    return cloud_of(means, quats, scales, rgb, 0.92), owner


def _free(site: Site, houses: Houses, places: F64, clear_m: float) -> Bool:
    """Return which places are off the road by ``clear_m``, not on actors' ground and outside
    houses.
    """
    free = (site.look_up(site.off_road_m, places) >= clear_m) & ~site.look_up(site.taken, places)
    for front, away in zip(houses.front, houses.away, strict=True):
        d = places - front.mean(axis=0)
        half = np.linalg.norm(front[1] - front[0]) / 2
        along = left_of(away)
        depth = d @ away
        free &= ~((np.abs(d @ along) < half + 0.8) & (depth > -0.9) & (depth < DEPTH_M + 1.0))
    return free


class LampPosts(NamedTuple):
    """Lamp posts along the road: feet, tops of the masts and tips of the arms ``(N, 3)``, metres,
    world; ``plan (N, 2)`` on the ground.
    """

    plan: F64
    foot: F64
    top: F64
    tip: F64


def lamp_posts(site: Site, houses: Houses) -> LampPosts:
    """Return the lamp posts of a scene, a function of the scene alone; the lamps hang at the
    tips.
    """
    spacing = site.scenario.environment.poles_spacing_m
    feet = [np.zeros((0, 2))]
    arms = [np.zeros((0, 2))]
    rng = site.rng("poles")
    if spacing > 0:
        for line in contours(site, 0.7 if not site.highway else 2.0, 60.0):
            spot = places(line, spacing, float(rng.uniform(2.0, min(spacing, 12.0))))
            free = _free(site, houses, spot.xy, 0.3)
            feet.append(spot.xy[free])
            arms.append(-spot.away[free])
    post_places = np.concatenate(feet)
    arm = np.concatenate(arms)
    foot = site.world(post_places)
    top = foot + np.array([0, 0, 6.8])
    tip = site.world(post_places + 1.7 * arm)
    tip[:, 2] = top[:, 2] + 0.35
    return LampPosts(post_places, foot, top, tip)


def _poles(site: Site, houses: Houses) -> list[Item]:
    """Set lamp posts along the road and the poles that the map names."""
    places, foot, top, tip = lamp_posts(site, houses)
    mapped = [line for line in site.scenario.lane_map.poles if len(line) > 1]
    if len(places) == 0 and not mapped:
        return []
    starts = [foot, top, *[line[:-1] for line in mapped]]
    ends = [top, tip, *[line[1:] for line in mapped]]
    start = np.concatenate(starts)
    end = np.concatenate(ends)
    owner = np.concatenate([places, places, *[site.frame.to_ground(line[:-1]) for line in mapped]])
    items = []
    for cell_m, step in ((0.3, 0.45), (1.2, 1.6)):
        poles = rods(start, end, 0.085, POLE_RGB, step)
        links = cell_counts(np.linalg.norm(end - start, axis=1), step)
        piece = np.repeat(np.arange(len(start)), links)
        lamp = cloud_of(tip, IDENTITY, (0.22, 0.22, 0.07), (0.85, 0.85, 0.80))
        items.append(
            (
                cell_m,
                GaussianCloud.concatenate([poles, lamp]),
                np.concatenate([owner[piece], places]),
            )
        )
    return items


def _signs(site: Site) -> list[Item]:
    """Place the map's signs: a coloured plate with a pale rim, and a post down to the ground where
    it is near.
    """
    signs = site.scenario.lane_map.signs
    if not signs:
        return []
    rng = site.rng("signs")
    corners, rgbs, feet, tops, places = [], [], [], [], []
    for T, box in signs:
        sizes = np.array([box.length_m, box.width_m])
        thin = int(np.argmin(sizes))
        side = np.zeros(3)
        side[1 - thin] = max(float(sizes[1 - thin]), 0.3) / 2
        up = np.array([0, 0, max(box.height_m, 0.3) / 2])
        normal = np.zeros(3)
        normal[thin] = 0.03
        colour = SIGN_RGB[rng.integers(4)]
        plate = np.stack([-side - up, side - up, side + up, -side + up])
        for shift, share, rgb in ((0.0, 1.0, RIM_RGB), (1.0, 0.72, colour), (-1.0, 0.72, colour)):
            corners.append((plate * share + shift * normal) @ T[:3, :3].T + T[:3, 3])
            rgbs.append(rgb)
            places.append(T[:2, 3])
        foot = site.world(site.frame.to_ground(T[None, :2, 3]))[0]
        if 0.5 < T[2, 3] - foot[2] < 4.5:
            feet.append(foot)
            tops.append(T[:3, 3])
    plan = site.frame.to_ground(np.array(places))
    items = []
    usual_m = USUAL_CELL_M["sign"]
    finer = [(usual_m / 2**n, 0.15 / 2**n) for n in halvings(site.scenario)]
    for cell_m, size in (*finer, (usual_m, 0.15), (0.4, 0.5)):
        plates, owner, _ = quad_surfels(np.stack(corners), np.stack(rgbs), size)
        clouds = [plates]
        owners = [plan[owner]]
        if feet:
            posts = rods(np.stack(feet), np.stack(tops), 0.04, POST_RGB, 3.0)
            clouds.append(posts)
            owners.append(site.frame.to_ground(posts.means.astype(np.float64)))
        items.append((cell_m, GaussianCloud.concatenate(clouds), np.concatenate(owners)))
    return items
