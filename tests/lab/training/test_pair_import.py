"""Anyone's own renders become pairs: videos, folders and arrays; what does not fit is said in four
parts.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.pair_import import PairSources, import_sequence, read_poses
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence
from alpasim_plugin.log.video import write_mp4

H, W = 32, 48
MOVED = np.eye(4) + np.outer(
    [3.0, 2.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]
)  # a pose away from the origin


def picture(i: int, height: int = H, width: int = W) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 180, width), np.linspace(0, 120, height))
    return np.stack([x, y, np.full_like(x, 10.0 * i)], axis=-1).astype(np.uint8)


@pytest.fixture
def sources(tmp_path: Path) -> PairSources:
    """Give 6 frames of render (mp4), 7 of truth (folder), 9 of opacity (array), 8 of map (mp4) and
    10 poses with times.
    """
    folder = tmp_path / "own"
    (folder / "gt").mkdir(parents=True)
    write_mp4(folder / "render.mp4", (picture(i) // 2 for i in range(6)), 10, crf=4)
    for i in range(7):
        cv2.imwrite(str(folder / "gt" / f"{i:03d}.png"), picture(i)[..., ::-1])
    np.save(folder / "alpha.npy", np.stack([picture(i)[..., 0] for i in range(9)]))
    write_mp4(folder / "map.mp4", (255 - picture(i) for i in range(8)), 10, crf=4)
    poses = []
    for i in range(10):
        T = np.eye(4)
        T[0, 3] = i
        poses.append({"T_world_camera": T.tolist(), "t_us": 40_000 * i})
    (folder / "poses.json").write_text(json.dumps(poses))
    names = ("render.mp4", "gt", "alpha.npy", "map.mp4", "poses.json")
    return PairSources(*(folder / name for name in names))


def test_channels_are_cut_to_the_shortest_and_keep_their_values(
    sources: PairSources, tmp_path: Path
) -> None:
    folder = tmp_path / "pairs" / "train" / "own"
    assert import_sequence(sources, folder, fps=10) == 6
    sequence = PairSequence(folder)
    clip = sequence.clip
    assert len(clip) == 6
    for i in range(6):
        np.testing.assert_array_equal(clip.rgb_gt[i], picture(i))
        np.testing.assert_array_equal(clip.opacity[i], picture(i)[..., 0])
        assert np.abs(clip.rgb_input[i].astype(int) - picture(i) // 2).mean() < 3  # video is lossy
        assert np.abs(clip.sdmap[i].astype(int) - (255 - picture(i))).mean() < 3
    np.testing.assert_array_equal(clip.t_us, 40_000 * np.arange(6))
    np.testing.assert_array_equal(clip.T_world_camera[:, 0, 3], np.arange(6))
    assert sequence.info["source_frames"] == {
        "rgb_input": 6,
        "rgb_gt": 7,
        "opacity": 9,
        "sdmap": 8,
        "poses": 10,
    }
    assert len(PairDataset(tmp_path / "pairs", "train")) == 1


def test_other_sizes_are_refused_or_scaled_on_request(sources: PairSources, tmp_path: Path) -> None:
    large = tmp_path / "large.mp4"
    write_mp4(large, (255 - picture(i, 2 * H, 2 * W) for i in range(8)), 10, crf=4)
    mixed, folder = replace(sources, sdmap=large), tmp_path / "pairs" / "train" / "own"
    with pytest.raises(InputError) as caught:
        import_sequence(mixed, folder, fps=10)
    assert "sdmap 96 x 64" in caught.value.message
    assert "rgb_gt 48 x 32" in caught.value.message
    assert "--size" in caught.value.hint
    assert not folder.exists()
    import_sequence(mixed, folder, fps=10, size=(W, H))
    clip = PairSequence(folder).clip
    assert clip.sdmap.shape == (6, H, W, 3)
    assert np.abs(clip.sdmap[3].astype(int) - (255 - picture(3))).mean() < 4


def test_poses_without_times_follow_the_frame_rate(tmp_path: Path) -> None:
    path = tmp_path / "poses.npy"
    np.save(path, np.tile(np.eye(4), (4, 1, 1)))
    T, times = read_poses(path, 25.0)
    assert T.shape == (4, 4, 4)
    assert times == [0, 40_000, 80_000, 120_000]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: {"rgb_gt": f / "nowhere"}, "no such file or folder"),
        (lambda f: {"rgb_gt": f}, "a folder without images"),
        (lambda f: {"opacity": _saved(f / "a.npy", np.zeros((4, H, W)))}, "float64"),
        (lambda f: {"poses": _saved(f / "p.npy", np.zeros((4, 3, 4)))}, r"shape \(4, 3, 4\)"),
        (
            lambda f: {"poses": _saved(f / "p.npy", np.tile(2 * np.eye(4), (4, 1, 1)))},
            "pose 0 is not a rigid",
        ),
        (
            lambda f: {"poses": _saved(f / "p.npy", np.tile(MOVED.T, (4, 1, 1)))},
            "pose 0 is not a rigid",
        ),
        (lambda f: {"poses": _written(f / "p.json", '[{"t_us": 0}]')}, "KeyError"),
        (
            lambda f: {
                "poses": _written(
                    f / "p.json",
                    json.dumps([{"T_world_camera": np.eye(4).tolist(), "t_us": 5}] * 2),
                )
            },
            "increase",
        ),
        (lambda f: {"sdmap": _written(f / "v.mp4", "no video")}, r"v\.mp4"),
    ],
)
def test_what_cannot_be_read_is_named(
    sources: PairSources, tmp_path: Path, change: object, message: str
) -> None:
    broken = replace(sources, **change(tmp_path))  # type: ignore[operator]
    with pytest.raises(InputError, match=message):
        import_sequence(broken, tmp_path / "pairs" / "train" / "own", fps=10)
    assert not (tmp_path / "pairs").exists()


def test_command_imports_and_refuses_names_that_are_paths(
    sources: PairSources, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [
        word
        for name, path in vars(sources).items()
        for word in (f"--{name.replace('_', '-')}", str(path))
    ]
    command = ["train", "import-pairs", str(tmp_path / "pairs"), *options]
    assert (
        run_command([*command, "--name", "drive", "--split", "test-known", "--size", "24x16"]) == 0
    )
    assert PairDataset(tmp_path / "pairs", "test-known").sequences[0].clip.rgb_gt.shape == (
        6,
        16,
        24,
        3,
    )
    for bad in (
        ["--name", "../drive"],
        ["--name", "drive", "--split", "tests"],
        ["--name", "drive", "--size", "big"],
    ):
        assert run_command([*command, *bad]) == 2
    assert "write WIDTHxHEIGHT" in capsys.readouterr().err


def _saved(path: Path, array: np.ndarray) -> Path:
    np.save(path, array)
    return path


def _written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path
