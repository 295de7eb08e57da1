import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.geometry import quat_from_yaw, se2, se3
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference
from alpasim_plugin.gaussians.scene.scene_graph import (
    Level,
    SceneGraph,
    SceneNode,
    in_view,
    nodes_by_tile,
    split_by_tile,
)
from alpasim_plugin.streets.builder import LongScene
from tests.examples import examples
from tests.gaussians.graph_scenes import SKY, blobs, camera, node


def choose(graph, view, poses, sharp=0):
    (background,) = graph.backgrounds([view])
    return graph._choose(view, poses, sharp, background)


def joined(chosen):
    clouds = [(node.levels[level].cloud, T) for node, level, T, _ in chosen]
    return GaussianCloud.concatenate([c if T is None else c.transformed(T) for c, T in clouds])


def test_nodes_rendered_in_one_pass_equal_the_reference_of_their_joined_cloud():
    background = [node(f"b{i}", blobs((8 + 4 * i, 3 - 2 * i, 1.0), n=12, seed=i)) for i in range(4)]
    graph = SceneGraph(
        background, [node("car", blobs((0, 0, 0), n=12, seed=9, sheen=True), "actor")], SKY
    )
    poses = {"car": se2(9.0, -0.5, 0.7, 1.2)}
    view = camera()
    fast = graph.render(view, poses)
    slow = rasterize_reference(joined(choose(graph, view, poses)), view, SKY.image(view))
    assert np.abs(fast.rgb - slow.rgb).max() <= 1.5 / 255
    assert np.abs(fast.alpha - slow.alpha).max() < 5e-3


def test_camera_and_actor_turned_together_see_the_same_image():
    cloud = blobs((0, 0, 0.5), sheen=True)
    graph = SceneGraph([], [node("a", cloud, "actor")], SKY)
    move = se3([300.0, -70.0, 4.0], quat_from_yaw(2.3))
    still = graph.render(camera(), {"a": se2(8, 0, 0.3)})
    moved = graph.render(camera(T_world_rig=move), {"a": move @ se2(8, 0, 0.3)})
    covered = still.alpha > 0.98  # the sky behind does not turn
    assert covered.any()
    assert_allclose(still.alpha, moved.alpha, atol=2e-4)
    assert_allclose(still.rgb[covered], moved.rgb[covered], atol=0.02)


def test_node_out_of_view_is_not_drawn_and_does_not_change_the_image():
    ahead = node("ahead", blobs((10, 0, 1)))
    behind = node("behind", blobs((-30, 0, 1), seed=3))
    both = SceneGraph([ahead, behind], [], SKY)
    one = SceneGraph([ahead], [], SKY)
    assert_array_equal(both.render(camera(), {}).rgb, one.render(camera(), {}).rgb)
    assert [chosen.node for chosen in choose(both, camera(), {})] == [ahead]


def test_node_beyond_its_far_limit_is_not_drawn():
    graph = SceneGraph([node("paint", blobs((60, 0, 1)), far_m=20.0)], [], SKY)
    assert not choose(graph, camera(), {})


@settings(deadline=None, max_examples=examples(200))
@given(
    st.tuples(*[st.floats(-30, 30)] * 3),
    st.floats(0.0, 5.0),
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.floats(-np.pi, np.pi),
)
def test_sphere_with_a_visible_point_is_always_in_view(
    centre,
    radius,
    inside,
    yaw,
):
    view = camera(T_world_rig=se2(1.0, -2.0, yaw))
    point = np.array(centre) + radius * np.array(inside) / max(1.0, float(np.linalg.norm(inside)))
    x, y, z = view.T_camera_world[:3, :3] @ point + view.T_camera_world[:3, 3]
    visible = (
        z > 0.1
        and 0 <= view.fx * x / z + view.cx <= view.width
        and 0 <= view.fy * y / z + view.cy <= view.height
    )
    assert not visible or bool(in_view(view, np.array([centre]), np.array([radius]))[0])


def test_farther_nodes_use_coarser_levels():
    levels = tuple(
        Level(cell, blobs((0, 0, 0.5), n=n)) for cell, n in ((0.1, 64), (0.4, 16), (1.6, 4))
    )
    graph = SceneGraph([], [SceneNode("a", "actor", levels)], SKY)
    chosen = [choose(graph, camera(), {"a": se2(x, 0, 0)}) for x in (6.0, 20.0, 400.0)]
    assert [one.level for (one,) in chosen] == [0, 1, 2]


def test_sky_is_not_in_alpha_unless_asked_for():
    graph = SceneGraph([], [], SKY)
    out = graph.render(camera(), {})
    assert out.alpha.max() == 0
    assert out.rgb.min() > 0.1
    assert graph.render(camera(), {}).covered(np.ones((1, 1), dtype=np.float32)).alpha.min() == 1


def test_splitting_by_tile_loses_nothing():
    cloud = blobs((0, 0, 0), n=101)
    tile = np.floor(cloud.means[:, 0]).astype(np.int64)
    parts = split_by_tile(cloud, tile)
    assert sum(len(p) for p in parts.values()) == 101
    for i, part in parts.items():
        assert np.all(np.floor(part.means[:, 0]) == i)


def test_same_sky_seen_while_turning_moves_across_the_image():
    a = SKY.image(camera(256, 96))
    b = SKY.image(camera(256, 96, se2(0, 0, 0.2)))
    assert np.abs(a - b).max() > 0.02  # clouds and hills moved
    assert_array_equal(
        SKY.image(camera(256, 96, se2(50, 9, 0.2))), b
    )  # and do not depend on where one stands


def test_a_tile_with_only_the_finest_level_is_left_to_sharp_cameras():
    """A kerb across a tile's border may have its middle in another tile at another size."""
    cloud = blobs((8, 0, 1))
    levels = [
        (0.05, cloud, np.zeros(40, dtype=np.int64)),
        (0.1, cloud, np.ones(40, dtype=np.int64)),
    ]
    graph = SceneGraph(nodes_by_tile("kerb", levels, usual_cell_m=0.1), [], SKY)
    names = [[one.node.name for one in choose(graph, camera(), {}, sharp)] for sharp in (0, 1)]
    assert names == [["kerb/1"], ["kerb/0", "kerb/1"]]


def test_a_scene_of_no_kind_draws_in_a_way_of_its_own():
    """What a subclass does beside `backgrounds` would be left out by callers of the other method."""
    kinds = [SceneGraph]
    for kind in kinds:
        kinds += kind.__subclasses__()
    for kind in kinds[1:]:
        assert not {"render", "render_all", "_choose"} & set(vars(kind)), kind
    assert LongScene in kinds
