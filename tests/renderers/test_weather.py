"""Weather: what distance, water and lamps do to light, and who is shown it."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin import load_scenario, make_renderer
from alpasim_plugin.core.errors import InputError, RendererError
from alpasim_plugin.core.types import (
    Actor,
    Box,
    CameraSpec,
    Exposure,
    Frame,
    Lane,
    RecordedFrame,
    RenderRequest,
    Signal,
    Trajectory,
)
from alpasim_plugin.renderers import weather
from alpasim_plugin.renderers.gaussian import CleanRenderer, clear_cache
from alpasim_plugin.renderers.lights import STREET_CD, SceneLights, Spot, drawn
from alpasim_plugin.renderers.precipitation import RAIN, SNOW, mirrored_share, wet_albedo
from alpasim_plugin.renderers.snow import ALBEDO, BESIDE, LANE, TRACK, SnowCover
from alpasim_plugin.renderers.view import view_of
from alpasim_plugin.renderers.weather import WeatherRenderer, in_weather
from alpasim_plugin.runs.gpu_check import frame_request
from alpasim_plugin.streets.build_facades import Houses, lit_windows
from alpasim_plugin.streets.site import make_site
from alpasim_plugin.world.ground import flat
from tests.camera_builders import ahead
from tests.examples import first_of
from tests.renderers.recorded_drive import recorded_drive

K = np.array([[100.0, 0, 50], [0, 100, 30], [0, 0, 1]])
AHEAD = ahead()
RIG = np.eye(4)
GREY = np.full((60, 100, 3), 120, dtype=np.uint8)


def test_what_is_less_than_half_opaque_is_sky_in_a_wide_image():
    wide = "cameras=[{name: front, width: 128, height: 96, hfov_deg: 120}]"
    scenario = load_scenario("smoke/curve", overrides=[wide])
    frame = make_renderer("clean", scenario).render(frame_request(scenario, 128, 96))
    assert frame.depth[1, 64] == 0


def depth_of_wall(distance_m):
    return np.full((60, 100), distance_m, dtype=np.float32)


def depth_of_road():
    """Level ground 1.5 m below the camera, and sky."""
    rows = (np.arange(60) + 0.5 - 30) / 100
    depth = np.where(rows > 0, 1.5 / np.maximum(rows, 1e-6), 0).astype(np.float32)
    return np.repeat(depth[:, None], 100, axis=1)


def view(depth, intrinsics=K):
    height, width = depth.shape
    camera = CameraSpec("front", width, height, intrinsics, np.eye(4))
    return view_of(depth, camera, AHEAD, flat())


def scene(*overrides, actors=(), signals=None):
    loaded = load_scenario("smoke/straight", overrides=[f"environment.{one}" for one in overrides])
    return replace(
        loaded, ground=flat(), actors=actors, lane_map=replace(loaded.lane_map, signals=signals)
    )


def car(heading_x, is_static=False):
    pose = np.eye(4)
    pose[:3, 3] = 15.0, 0.0, 0.75
    pose[:2, :2] *= heading_x
    track = Trajectory(np.array([0, 1]), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    return Actor("car", "car", Box(4.5, 1.8, 1.5), track, is_static), {"car": pose}


class Flat:
    lookahead = 0
    block = None
    has_history = False

    def render(self, request):
        return Frame(request.t_us, request.camera.name, np.zeros((16, 32, 3), dtype=np.uint8))

    def facts(self):
        return {}


def shown(scenario, depth, rgb=GREY, actors=None, t_us=0, pose=AHEAD):
    one = RecordedFrame(t_us, "front", K, pose, actors or {}, lambda: (rgb, depth))
    base = Flat()
    base.recorded = lambda: [one]
    renderer = WeatherRenderer(base, scenario, 0)
    renderer.built = None  # the depth is the frame's, as that of a recorded drive is
    return renderer.recorded()[0].read()[0]


@pytest.mark.parametrize(
    ("overrides", "per_m"),
    [
        (("fog_visibility_m=120",), 3.912 / 120),
        (("rain=25",), 1.076 * 25**0.67 / 4343),
        (("snow=3",), 5.53 * 3**1.38 / 4343),
        (("fog_visibility_m=120", "rain=25"), 3.912 / 120 + 1.076 * 25**0.67 / 4343),
    ],
)
def test_what_falls_takes_light_away_beside_fog(overrides, per_m):
    found = WeatherRenderer(Flat(), scene(*overrides), 0).extinction
    assert found == pytest.approx(per_m, rel=0.001)


@pytest.mark.parametrize("street", first_of(["built", "imported", "argoverse"]))
def test_fog_lets_light_through_by_the_exponent_of_the_distance(street, request, tmp_path):
    """Within 2 %, to 150 m, from the images of a street in clear air and in fog."""
    if street == "imported":
        clear = recorded_drive(tmp_path, long_m=170.0)
    elif street == "argoverse":
        clear = load_scenario(request.getfixturevalue("data_set")("av2") / "7fab2350")
    else:
        clear = load_scenario("smoke/straight")
    foggy = replace(clear, environment=replace(clear.environment, fog_visibility_m=400.0))
    renderer = "3dgs" if street == "imported" else "clean"
    before, after = (
        make_renderer(renderer, one).render(frame_request(one, 320, 180)) for one in (clear, foggy)
    )
    clear_cache()
    camera = frame_request(clear, 320, 180).camera
    columns, rows = np.meshgrid(np.arange(320) + 0.5, np.arange(180) + 0.5)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.K).T
    distance_m = before.depth * np.linalg.norm(rays, axis=2)
    air = weather.LIGHT_OF_BYTE[list(weather.FOG_SRGB)]
    light, hazy = (weather.LIGHT_OF_BYTE[frame.rgb] - air for frame in (before, after))
    compared = (np.abs(light).min(axis=2) > 0.2) & (distance_m > 0)
    for low_m in (5, 30, 60, 90, 120):
        there = compared & (distance_m > low_m) & (distance_m < low_m + 30)
        assert there.sum() > 5
        due = np.exp(-3.912 / 400 * distance_m[there])[:, None]
        assert np.median(hazy[there] / light[there] / due) == pytest.approx(1, abs=0.02)


def test_fog_mixes_linear_light_and_hides_the_sky():
    scenario = scene("fog_visibility_m=100")
    depth = depth_of_wall(50.0)
    depth[:20] = 0
    found = shown(scenario, depth, np.zeros_like(GREY))
    assert (found[:20] == weather.FOG_SRGB).all()
    through = np.exp(-3.912 / 100 * view(depth).distance_m[40, 50])
    fog = ((np.array(weather.FOG_SRGB) / 255 + 0.055) / 1.055) ** 2.4
    due = 255 * (1.055 * (fog * (1 - through)) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(found[40, 50], due, atol=1.0)


def test_a_hole_in_the_ground_is_as_far_as_the_ground_around_it():
    depth = depth_of_wall(10.0)
    depth[45:50, 40:60] = 0
    found = view(depth).distance_m
    assert found[47, 50] == pytest.approx(found[44, 50], rel=0.02)
    assert np.isinf(view(depth_of_wall(0.0)).distance_m).all()


def test_ground_that_a_model_shows_too_near_is_put_on_the_ground():
    true = view(depth_of_road())
    near = view(0.9 * depth_of_road())
    below = slice(36, None)
    assert (true.ground[below] == 1).all()
    assert (near.ground[below] == 1).all()
    assert np.abs(near.points[below, :, 2] + 1.5).max() < 1e-3
    assert not view(depth_of_wall(20.0)).ground[:31].any()


def test_wet_ground_is_darker_and_a_mirror_at_grazing_angles():
    dry = np.linspace(0, 1, 11, dtype=np.float32)
    wet = wet_albedo(dry)
    assert wet[0] == 0
    assert (np.diff(wet) > 0).all()
    assert (wet[1:-1] < dry[1:-1]).all()
    assert wet_albedo(np.float32(0.2)) == pytest.approx(0.109, abs=0.002)  # by hand
    steep, grazing = mirrored_share(np.array([1.0, 0.05], dtype=np.float32))
    assert steep == 0
    assert 0.1 < grazing < 0.15
    road = shown(scene("rain=10"), depth_of_road())
    assert road[55].mean() < GREY.mean() - 15


@pytest.mark.parametrize(
    ("kind", "light_rate", "heavy_rate"), [(RAIN, 20.0, 80.0), (SNOW, 1.0, 5.0)]
)
def test_what_falls_is_drawn_by_its_stream_and_by_the_rate(kind, light_rate, heavy_rate):
    once, again, other = (
        kind.covered((60, 100), K, light_rate, np.random.default_rng(key)) for key in (1, 1, 2)
    )
    assert np.array_equal(once, again)
    assert not np.array_equal(once, other)
    heavy = kind.covered((60, 100), K, heavy_rate, np.random.default_rng(1))
    assert 0 < once.mean() < heavy.mean() < 0.2
    assert heavy.max() <= 1
    scenario = scene(f"{kind.name}={light_rate}")
    first, same, later = (shown(scenario, depth_of_road(), t_us=t) for t in (0, 0, 100_000))
    assert np.array_equal(first, same)
    assert not np.array_equal(first, later)


def test_snow_lies_by_the_map_and_not_on_road_users():
    scenario = scene("snow=0.001")  # next to none falls
    car_there, poses = car(1.0)
    lane = Lane("one", *(np.array([[0.0, y, 0], [80.0, y, 0]]) for y in (0.0, 1.75, -1.75)))
    scenario = replace(
        scenario, lane_map=replace(scenario.lane_map, lanes={"one": lane}), actors=(car_there,)
    )
    image = shown(scenario, depth_of_road(), np.zeros_like(GREY))
    lit = weather.LIGHT_OF_BYTE[image].mean(axis=2)
    row = 50  # 7.3 m ahead
    columns = (50 + 100 * np.array([0.0, 0.8, -0.8, 3.0]) / 7.3).astype(int)
    np.testing.assert_allclose(
        lit[row, columns], ALBEDO * np.array([LANE, TRACK, TRACK, BESIDE]), atol=0.02
    )
    wide = np.array([[30.0, 0, 50], [0, 30, 30], [0, 0, 1]])
    near = SnowCover(scenario).on(view(depth_of_road() * 0.3, wide))
    columns = (50 + 30 * np.array([0.0, 0.8, -0.8, 2.3]) / 1.58).astype(int)
    np.testing.assert_allclose(near[58, columns], [LANE, TRACK, TRACK, BESIDE], atol=0.02)
    wall = depth_of_wall(12.9)  # the rear of the car, whose lower part is as low as the ground
    assert shown(scenario, wall, np.zeros_like(GREY), poses)[40, 50].max() < 20


class WrongDepth:
    """Shows what `clean` shows, as if all of it were 4 m away: a reconstruction at its worst."""

    lookahead = 0
    block = None
    has_history = False

    def __init__(self, scenario):
        self.clean = CleanRenderer(scenario, 0, "cpu", None)

    def render(self, request):
        frame = self.clean.render(request)
        return replace(frame, depth=np.full_like(frame.depth, 4.0))

    def recorded(self):
        request = frame_request(self.clean.scenario, 256, 144)
        frame = self.render(request)
        pose = request.T_world_camera[1]
        image = frame.rgb, frame.depth
        seen = request.t_us, "front", request.camera.K, pose, request.actors, lambda: image
        return [RecordedFrame(*seen)]


@pytest.mark.parametrize("setting", ["time=night", "snow=2", "fog_visibility_m=100"])
def test_lamps_snow_and_air_are_where_the_scene_is_behind_every_renderer(setting):
    scenario = load_scenario("smoke/lead_car", overrides=[f"environment.{setting}"])
    request = frame_request(scenario, 256, 144)
    wrong = WrongDepth(scenario)
    due = WeatherRenderer(wrong.clean, scenario, 0).render(request).rgb
    over = WeatherRenderer(wrong, scenario, 0)
    assert np.array_equal(over.render(request).rgb, due)
    recorded, depth = over.recorded()[0].read()
    assert np.array_equal(recorded, due)
    assert (depth == 4.0).all()  # the fixer's warps need what the renderer sees


def test_lit_windows_lie_in_the_floors_of_walls_on_a_slope():
    scenario = load_scenario("smoke/straight", overrides=["environment.time=night"])
    site = make_site(scenario, lambda xy: 0.1 * np.asarray(xy)[:, 0])
    house = Houses(
        np.array([[[0.0, 12.0], [18.0, 12.0]]]), np.array([[0.0, 1.0]]), np.array([12.4])
    )
    _, middles, _ = lit_windows(site, house)
    base = site.world(house.front[0])[:, 2].min() - 0.2
    floor = (middles[:, 2] - base) / (12.6 / 4) - 0.5
    assert len(floor) > 3
    assert np.allclose(floor, np.round(floor), atol=1e-6)


def test_a_street_lamp_lights_by_cosine_over_the_square_of_the_distance():
    scenario = scene("time=night")
    lamps = SceneLights(scenario)
    assert len(lamps.tips)
    assert len(lamps.windows)
    lamps.tips = np.array([[10.0, 0.0, 6.0]])
    seen = view(depth_of_road())
    far_away = np.eye(4)
    far_away[0, 3] = 1e6  # the ego's own beams light nothing here
    lux = lamps.lux(seen, far_away)
    d = seen.points - np.array([10.0, 0.0, 4.5])
    r = np.linalg.norm(d, axis=2)
    np.testing.assert_allclose(lux[40:], (STREET_CD * -d[..., 2] / r**3)[40:], rtol=0.01)
    assert not lux[:30].any()


def test_lamps_of_road_users_come_in_the_order_of_the_scene_in_every_process():
    """The order of a set of names changes with the process; where lamps overlap it decides."""
    base, present = car(1.0)
    cars = tuple(replace(base, actor_id=f"car-{i}") for i in range(20))
    poses = {}
    for i, actor in enumerate(cars):
        pose = present["car"].copy()
        pose[0, 3] += 10.0 * i
        poses[actor.actor_id] = pose
    lamps = SceneLights(scene("time=night", "poles_spacing_m=0", "buildings=0", actors=cars))
    backwards = dict(reversed(poses.items()))
    spots = lamps.spots(backwards, 0)[-4 * len(cars) :]
    places = [spot.middle[0] for spot in spots]
    assert places == sorted(places, key=lambda x: (x - 10) // 10)


def test_night_is_dark_but_for_the_beams_of_the_ego():
    scenario = scene("time=night", "poles_spacing_m=0", "buildings=0")
    road = shown(scenario, depth_of_road()).astype(float).mean(axis=2)
    assert road[:30].max() < 60
    assert GREY.mean() > road[40].max() > road[40, 0] + 5
    parked, poses = car(1.0, is_static=True)
    scenario = replace(scenario, actors=(replace(parked, box=Box(4.5, 30.0, 10.0)),))
    wall = shown(scenario, depth_of_wall(12.9), actors=poses).astype(float).mean(axis=2)
    assert wall[38, 50] > 2 * wall[20, 50]  # the upper edge of a low beam


@pytest.mark.parametrize("name", ["front", "camera_front_wide_120fov"])
def test_beams_start_at_the_ego_of_the_request_whatever_its_camera_is_called(name, monkeypatch):
    """The rig stands 3 m beside the recorded path, and later than the recording ends."""
    scenario = scene("time=night")
    given = frame_request(scenario, 100, 60)
    T_world_rig = np.eye(4)
    T_world_rig[:3, 3] = 10.0, 3.0, 0.0
    camera = replace(given.camera, name=name, width=100, height=60, K=K)
    asked = replace(
        given,
        t_us=int(scenario.ego_log.t_us[-1]) + 1_000_000,
        camera=camera,
        T_world_camera=np.stack([T_world_rig @ camera.T_rig_camera] * 2),
    )
    rigs = []
    monkeypatch.setattr(
        SceneLights,
        "lux",
        lambda self, view, rig: rigs.append(rig) or np.zeros((60, 100), dtype=np.float32),
    )

    class Wall:
        lookahead = block = 1
        has_history = False

        def render(self, request):
            depth = depth_of_wall(20.0)
            return Frame(request.t_us, request.camera.name, GREY, np.ones_like(depth), depth)

    WeatherRenderer(Wall(), scenario, 0).render(asked)
    assert np.allclose(rigs[0], T_world_rig)


def test_weather_of_a_rolling_shutter_is_seen_from_its_middle(monkeypatch):
    """The car turns while the shutter is open; lamps lie where the middle row shows them."""
    scenario = scene("time=night", "poles_spacing_m=0", "buildings=0")
    asked = frame_request(scenario, 32, 18)
    start, end = np.eye(4), np.eye(4)
    start[:3, 3] = 2.0, 0.0, 0.0
    poses = np.stack([start @ asked.T_world_camera[1], end @ asked.T_world_camera[1]])
    exposure = Exposure(np.linspace(0, 1, 18, dtype=np.float32)[:, None], {})
    asked = replace(asked, T_world_camera=poses, actors={}, exposure=exposure)
    places = []
    monkeypatch.setattr(
        WeatherRenderer,
        "_in_weather",
        lambda self, rgb, depth, frame, camera, rig: (
            places.append(frame.T_world_camera[:3, 3]) or rgb
        ),
    )
    WeatherRenderer(WrongDepth(scenario), scenario, 0).render(asked)
    np.testing.assert_allclose(places[0], poses.mean(axis=0)[:3, 3], atol=1e-9)


@pytest.mark.parametrize(("heading_x", "is_red"), [(1.0, True), (-1.0, False)])
def test_lamps_of_road_users_are_red_from_behind_and_white_from_ahead(heading_x, is_red):
    actor, poses = car(heading_x)
    none = ("time=night", "poles_spacing_m=0", "buildings=0")
    image = shown(scene(*none, actors=(actor,)), depth_of_wall(13.0), actors=poses).astype(int)
    brightest = image.reshape(-1, 3)[image.max(axis=2).argmax()]
    assert brightest[0] == 255
    assert (brightest[2] < 120) == is_red
    hidden = shown(scene(*none, actors=(actor,)), depth_of_wall(8.0), actors=poses)
    assert hidden.max() < 255
    parked, _ = car(heading_x, is_static=True)
    assert not np.array_equal(
        shown(scene(*none, actors=(parked,)), depth_of_wall(13.0), actors=poses), image
    )


def test_a_lamp_that_is_hidden_is_not_mirrored_in_wet_ground():
    oncoming, poses = car(-1.0)
    wet = scene("time=night", "rain=20", "poles_spacing_m=0", "buildings=0", actors=(oncoming,))
    road = depth_of_road()
    mirrored = shown(wet, road, actors=poses).astype(int) - shown(wet, road)
    assert mirrored[36:].max() > 20
    behind_a_wall = np.where((road == 0) | (road > 8.0), np.float32(8.0), road)
    assert np.array_equal(
        shown(wet, behind_a_wall, actors=poses), shown(wet, behind_a_wall, actors={})
    )


def test_a_low_sun_ahead_veils_the_image_unless_it_is_hidden():
    scenario = scene("time=low_sun")
    to_camera = np.eye(4)
    heading = scenario.ego_log.quat[0]
    yaw = 2 * np.arctan2(heading[3], heading[0])
    c = np.cos(yaw)
    s = np.sin(yaw)
    to_camera[:2, :2] = [[c, -s], [s, c]]
    pose = to_camera @ AHEAD
    open_sky, walled = (
        shown(scenario, depth, pose=pose).astype(int)
        for depth in (depth_of_wall(0.0), depth_of_wall(20.0))
    )
    assert open_sky.max() == 255
    assert open_sky[20, 20].mean() > walled[20, 20].mean() + 5
    assert walled[..., 0].mean() > walled[..., 2].mean() + 15


def signal(phases, heading_rad=0.0):
    stop = np.array([[10.0, -2, 0], [10.0, 2, 0]])
    return Signal(stop, heading_rad, phases, head=np.array([12.0, -2.0, 3.0]))


@pytest.mark.parametrize(("t_us", "channel"), [(0, 0), (1_500_000, 1)])
def test_a_traffic_light_shows_its_state_by_clear_day(t_us, channel):
    phases = (("red", 1_000_000), ("green", 1_000_000))
    scenario = scene(signals=(signal(phases),))
    changed = shown(scenario, depth_of_wall(40.0), t_us=t_us).astype(int)
    lit = changed[..., channel] - changed[..., 1 - channel] > 100
    assert lit.any()
    assert (changed == GREY).all(axis=2).mean() > 0.9
    assert (changed.max(axis=2) < 40).any()  # the housing
    away = scene(signals=(signal(phases, np.pi),))
    assert (shown(away, depth_of_wall(40.0), t_us=t_us) == GREY).all()
    assert (shown(scenario, depth_of_wall(5.0), t_us=t_us) == GREY).all()


class Unread:
    """The depth of a built scene that nobody may read."""

    def of_request(self, request):
        raise AssertionError("the scene is drawn a second time")

    def of_recorded(self, frame, height, width):
        raise AssertionError("the scene is drawn a second time")


def test_a_clear_day_without_a_light_in_view_stays_as_it_is_and_nothing_is_drawn_a_second_time():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (60, 100, 3), dtype=np.uint8)
    rgb.ravel()[:256] = np.arange(256)
    depth = depth_of_wall(40.0)
    phases = (("red", 1_000_000),)
    behind = replace(signal(phases), head=np.array([-12.0, -2.0, 3.0]))
    for hidden in (signal(phases, np.pi), behind):
        scenario = scene(signals=(hidden,))
        renderer = WeatherRenderer(Flat(), scenario, 0)
        renderer.built = Unread()
        one = RecordedFrame(0, "front", K, AHEAD, {}, lambda: (rgb, depth))
        renderer.base.recorded = lambda one=one: [one]
        image, seen_depth = renderer.recorded()[0].read()
        assert image is rgb
        assert seen_depth is depth
        camera = CameraSpec("front", 100, 60, K, np.eye(4))
        assert np.array_equal(renderer._in_weather(rgb, depth, one, camera, np.eye(4)), rgb)
        spec = replace(scenario.cameras[0], name="front", width=100, height=60, K=K)
        request = RenderRequest(0, spec, np.stack([AHEAD, AHEAD]), {})
        frame = Frame(0, "front", rgb, np.ones((60, 100), dtype=np.float32), depth)
        renderer.base.render = lambda request, frame=frame: frame
        assert renderer.render(request) is frame
    in_view = WeatherRenderer(renderer.base, scene(signals=(signal(phases),)), 0)
    in_view.built = Unread()
    with pytest.raises(AssertionError, match="a second time"):
        in_view.render(request)


def test_spots_at_the_border_of_an_image_are_those_of_a_larger_image():
    rng = np.random.default_rng(0)
    pixels = rng.uniform(-8, [108, 68], (300, 2))
    depths = rng.uniform(2, 60, 300)
    rays = np.column_stack([pixels, np.ones(300)]) @ np.linalg.inv(K).T
    middles = (rays * depths[:, None]) @ AHEAD[:3, :3].T + AHEAD[:3, 3]
    spots = [
        Spot(middle, np.zeros(3), half_m, (1.0, 0.5, 0.2))
        for middle, half_m in zip(middles, rng.uniform(0.01, 0.4, 300), strict=True)
    ]
    seen = view(np.zeros((60, 100), dtype=np.float32))
    beyond = K.copy()
    beyond[:2, 2] += 64
    larger = view(np.zeros((188, 228), dtype=np.float32), beyond)
    inner = slice(64, -64), slice(64, -64)
    for image, whole in zip(drawn(spots, seen), drawn(spots, larger), strict=True):
        np.testing.assert_array_equal(image, whole[inner])


def test_spots_behind_the_camera_are_not_drawn():
    seen = view(depth_of_wall(0.0))
    light, depth = drawn([Spot(np.array([-30.0, 0, 0]), np.zeros(3), 1.0, (1.0, 0, 0))], seen)
    assert np.isinf(depth).all()
    assert not light.any()


@pytest.mark.slow
def test_a_fixer_keeps_the_fog():
    short = ["timing.duration_us=1500000", "timing.warmup_us=200000"]
    fog = (short, [*short, "environment.fog_visibility_m=80"])
    scenarios = [load_scenario("smoke/curve", overrides=overrides) for overrides in fog]
    clear, foggy = (
        make_renderer("onefixer", scenario)
        .render(frame_request(scenario, 256, 144))
        .rgb.astype(float)
        for scenario in scenarios
    )
    far = slice(60, 72)
    near = slice(-12, None)
    assert foggy[far].std() < 0.8 * clear[far].std()
    assert foggy[near].std() > 0.3 * clear[near].std()
    assert (foggy[:10].max(axis=2) >= weather.FOG_SRGB[2] - 40).mean() > 0.2  # no blue sky
    clear_cache()


def test_a_renderer_without_depth_cannot_be_put_into_weather():
    clear = scene()
    assert type(in_weather(Flat(), clear, 0)) is Flat
    request = frame_request(clear, 32, 16)
    with pytest.raises(RendererError):
        in_weather(Flat(), scene("time=night"), 0).render(request)
    with_signal = scene(signals=(signal((("red", 1),)),))
    assert not in_weather(Flat(), with_signal, 0).render(request).rgb.any()


@pytest.mark.parametrize(("heading_rad", "unlit"), [(0.0, 2), (np.pi, None)])
def test_frames_without_depth_that_look_at_a_traffic_light_are_counted(heading_rad, unlit):
    scenario = scene(signals=(signal((("red", 1_000_000),), heading_rad),))
    spec = replace(scenario.cameras[0], name="front", width=100, height=60, K=K)
    renderer = WeatherRenderer(Flat(), scenario, 0)
    for t_us in (0, 100_000):
        renderer.render(RenderRequest(t_us, spec, np.stack([AHEAD, AHEAD]), {}))
    assert renderer.facts().get("unlit_frames") == unlit


@pytest.mark.parametrize(
    "given",
    [
        "fog_visibility_m=0",
        "fog_visibility_m=nan",
        "fog_visibility_m=thick",
        "time=noon",
        "rain=-1",
        "rain=heavy",
        "snow=11",
        "snow=nan",
        "friction=0",
        "friction=1.6",
    ],
)
def test_weather_that_is_none_is_refused(given):
    with pytest.raises(InputError):
        load_scenario("smoke/curve", overrides=[f"environment.{given}"])
