"""Histories without sessions: every frame finds its own drive's past, whoever else is on the same
road.
"""

import numpy as np
import pytest

from alpasim_plugin.alpasim.server.history import HistoryTree, apart, on_line
from alpasim_plugin.alpasim.server.views import read_view
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import se2
from tests.alpasim.server_histories import SLOWLY_APART
from tests.alpasim.service_cases import START_US, STEP_US, drive, request


def tree(max_bytes=1 << 30, expiry_s=60.0, clock=lambda: 0.0):
    return HistoryTree(max_bytes, expiry_s, clock)


def serve(kept, view, size=100):
    """Give a view its lineage: the keys of all frames from the start of its drive to itself. That
    is all that a fixer could depend on.
    """
    known = kept.find(view)
    if known is None:
        parent = kept.parent_of(view)
        known = kept.add(view, (*(parent.state if parent else ()), view.key), size, parent)
    return known.state


def views(*args, **options):
    return [read_view(r) for r in drive(*args, **options)]  # type: ignore[arg-type]


def interleaved(drives, seed):
    """Return the frames of all drives mixed at random, each drive's in its own order."""
    rng = np.random.default_rng(seed)
    left = [list(d) for d in drives]
    out = []
    while any(left):
        out.append(left[rng.choice([i for i, rest in enumerate(left) if rest])].pop(0))
    return out


FAST_APART = ({}, {}, {"aside_mps": 1.5}, {"aside_mps": -1.2}, {"brake_mps2": 8.0})


@pytest.mark.parametrize(("shutter_us", "kinds"), [(30_000, SLOWLY_APART), (0, FAST_APART)])
def test_interleaved_drives_have_the_past_that_each_has_alone(shutter_us, kinds):
    """Drives that are equal, swerve, or brake to a stop, so that one lies a step or more behind
    another in the same lane.
    """
    drives = [
        views(22, parts_at=6 + i, shutter_us=shutter_us, **kind) for i, kind in enumerate(kinds)
    ]
    alone = []
    for one in drives:
        own = tree()
        alone.append([serve(own, view) for view in one])
        assert [len(lineage) for lineage in alone[-1]] == list(range(1, 23))
    for seed in range(2):
        shared = tree()
        got = {view.key: serve(shared, view) for view in interleaved(drives, seed)}
        assert [[got[view.key] for view in one] for one in drives] == alone
        assert shared.counts.starts == 1


def test_a_step_back_forks_and_leaves_the_first_branch_alone():
    kept = tree()
    first = views(12)
    second = views(12, parts_at=5, aside_mps=0.4)
    before = [serve(kept, view) for view in first]
    after = [
        serve(kept, view) for view in second[3:]
    ]  # back to a frame that is known, then another way
    assert [serve(kept, view) for view in first] == before
    assert after[-1][:6] == before[5][:6]
    assert (after[-1][-1], kept.counts.starts) == (second[-1].key, 1)


def test_another_place_camera_lens_or_scene_starts_a_history():
    kept = tree()
    known = drive(5)
    for r in known:
        serve(kept, read_view(r))
    far = se2(500.0, 0.0, 0.0)
    t_us = START_US + 5 * STEP_US
    assert kept.parent_of(read_view(drive(6)[5])) is not None
    assert kept.parent_of(read_view(request(far, far, t_us))) is None
    for change in ({"camera": "camera_rear"}, {"scene_id": "other"}):
        assert kept.parent_of(read_view(drive(6, **change)[5])) is None
    wider = drive(6)[5]
    wider.resolution_w += 16
    assert kept.parent_of(read_view(wider)) is None


def test_drives_that_differ_in_traffic_alone_stay_apart():
    def with_car(requests, later_mps):
        for step, r in enumerate(requests):
            car = r.dynamic_objects.add(track_id="car")
            for pose, t_s in (
                (car.pose_pair.start_pose, step * 0.1 - 0.03),
                (car.pose_pair.end_pose, step * 0.1),
            ):
                pose.vec.x, pose.quat.w = (
                    20 + 10 * min(t_s, 0.3) + later_mps * max(t_s - 0.3, 0.0),
                    1.0,
                )
        return [read_view(r) for r in requests]

    drives = [with_car(drive(10), speed) for speed in (10.0, 9.0)]
    kept = tree()
    got = [[serve(kept, view) for view in pair] for pair in zip(*drives, strict=True)]
    for i in (0, 1):
        assert got[-1][i] == tuple(view.key for view in drives[i])


def test_memory_is_bounded_and_the_drives_ends_go_last():
    kept = tree(max_bytes=1000)
    slow = views(3, parts_at=1, aside_mps=2.0)
    for view in slow:
        serve(kept, view)
    for view in views(60):
        assert serve(kept, view)[-1] == view.key
        assert kept.bytes <= 1000
    assert kept.find(slow[-1]) is not None  # the end of a branch, long unused
    assert len(kept) == 10
    serve(kept, views(61)[60])
    assert kept.counts.starts == 1


def test_a_frame_in_use_stays_and_one_unused_for_as_long_expires():
    now_s = [0.0]
    kept = tree(expiry_s=60.0, clock=lambda: now_s[0])
    used, unused, *_ = views(2)
    other = views(1, scene_id="other")[0]
    for view in (used, unused, other):
        now_s[0] += 1.0
        serve(kept, view)
    now_s[0] = 50.0
    assert kept.find(used) is not None
    now_s[0] = 70.0
    kept.expire()
    assert [kept.find(view) is not None for view in (used, unused, other)] == [True, False, False]


def test_motion_is_continued_in_place_and_turn():
    a = se2(0, 0, 0.1)
    b = se2(1, 0.5, 0.2)
    assert apart(on_line(a, b, 3.0), se2(3, 1.5, 0.4)) < 1e-6
    assert apart(on_line(a, b, -1.0), se2(-1, -0.5, 0.0)) < 1e-6


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda r: r.ClearField("resolution_w"), "0 x 32 pixels"),
        (lambda r: setattr(r, "frame_start_us", r.frame_end_us + 1), "a shutter from"),
        (lambda r: r.ClearField("sensor_pose"), r"\|q\|\^2 = 0"),
        (lambda r: setattr(r.sensor_pose.end_pose.vec, "x", float("nan")), "nan"),
        (lambda r: setattr(r.sensor_pose.start_pose.quat, "w", 2.0), r"\|q\|\^2"),
        (
            lambda r: [
                r.dynamic_objects.add(track_id="a", pose_pair=r.sensor_pose) for _ in range(2)
            ],
            "a track id twice",
        ),
    ],
)
def test_a_request_that_is_no_view_is_refused(change, found):
    bad = drive(1)[0]
    change(bad)
    with pytest.raises(InputError, match=found):
        read_view(bad)
