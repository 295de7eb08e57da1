"""Refining video files: times kept, blocks of the fixer's rule, inputs that do not belong together,
memory that does not grow.
"""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import BlockRule
from alpasim_plugin.log.video import VideoReader, VideoWriter
from alpasim_plugin.runs.refine import RefineFiles, refine_video

RATE = Fraction(10)


class Inverting:
    """Returns negatives and remembers what it was given; where the opacity is low it puts the
    map.
    """

    trained = True
    label = "inverting"

    def __init__(self, rule=BlockRule(5, 8)):
        self.blocks = rule
        self.sizes = []
        self.seen = []

    def reset(self, seed):
        self.sizes = []
        self.seen = []

    def preview(self, block, maps):
        raise AssertionError("a video's blocks are final")

    def step(self, block, maps):
        self.sizes.append(len(block))
        self.seen += block
        out = []
        for i, frame in enumerate(block):
            image = 255 - frame.rgb
            if frame.alpha is not None and maps:
                image = np.where(frame.alpha[..., None] < 0.5, maps[i], image)
            out.append(
                replace(frame, rgb=image, events=("fixer-black",) if frame.rgb.max() < 3 else ())
            )
        return out


def pictures(n, width=64, height=36):
    x = np.linspace(0, 200, width, dtype=np.float32)
    return [
        np.repeat(np.tile(x + i, (height, 1))[..., None], 3, 2).astype(np.uint8) for i in range(n)
    ]


def video(
    path,
    frames,
    rate=RATE,
    times=None,
    base=None,
):
    with VideoWriter(path, base or 1 / rate, rate, crf=2) as writer:
        for i, image in enumerate(frames):
            writer.write(image, i if times is None else times[i])
    return path


def read(path):
    with VideoReader(path) as reader:
        frames = list(reader)
        return [f.time * reader.format.time_base for f in frames], np.stack(
            [f.image for f in frames]
        )


@pytest.mark.parametrize(("n", "sizes"), [(1, [1]), (5, [5]), (6, [5, 1]), (22, [5, 8, 8, 1])])
def test_every_length_is_cut_into_the_fixers_blocks(tmp_path, n, sizes):
    fixer = Inverting()
    given = pictures(n)
    files = RefineFiles(video(tmp_path / "in.mp4", given), tmp_path / "out.mp4")
    done = []
    summary = refine_video(
        files, lambda: fixer, lambda frames, claimed: done.append((frames, claimed))
    )
    times, images = read(files.out)
    assert fixer.sizes == sizes
    assert done == [(sum(sizes[: i + 1]), n) for i in range(len(sizes))]
    assert times == [Fraction(i, 10) for i in range(n)]
    assert np.abs(images.astype(int) - (255 - np.stack(given))).mean() < 2
    assert summary.frames == n
    assert summary.psnr_db is not None
    assert 30 < summary.mean_levels < 120
    assert [f.t_us for f in fixer.seen] == [i * 100_000 for i in range(n)]


def test_opacity_and_map_reach_the_fixer_frame_by_frame(tmp_path):
    given = pictures(7)
    hole = [np.full_like(given[0], 255) for _ in given]
    for i, image in enumerate(hole):
        image[:, : 8 * i] = 0
    maps = [np.full_like(given[0], 20 * i) for i in range(7)]
    files = RefineFiles(
        video(tmp_path / "in.mp4", given),
        tmp_path / "out.mp4",
        video(tmp_path / "alpha.mp4", hole),
        video(tmp_path / "map.mp4", maps),
        tmp_path / "side.mp4",
    )
    refine_video(files, Inverting)
    _, images = read(files.out)
    want = [np.where(h < 128, m, 255 - g) for g, h, m in zip(given, hole, maps, strict=True)]
    assert np.abs(images.astype(int) - np.stack(want)).mean() < 4
    assert files.compare is not None
    times, side = read(files.compare)
    assert times == [Fraction(i, 10) for i in range(7)]
    assert side.shape == (7, 36, 128, 3)
    assert np.abs(side[:, :, :64].astype(int) - np.stack(given)).mean() < 2
    assert np.abs(side[:, :, 64:].astype(int) - images).mean() < 2


def test_odd_sizes_are_padded_in_the_file_only(tmp_path):
    fixer = Inverting()
    source = tmp_path / "in.mkv"
    write_odd(source, pictures(3, 61, 35))
    summary = refine_video(RefineFiles(source, tmp_path / "out.mp4"), lambda: fixer)
    assert (summary.width, summary.height) == (61, 35)
    assert fixer.seen[0].rgb.shape == (35, 61, 3)
    assert read(tmp_path / "out.mp4")[1].shape == (3, 36, 62, 3)


def write_odd(path, frames):
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = frames[0].shape[1], frames[0].shape[0], "bgr0"
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
        container.mux(stream.encode())


def misfits(folder):
    """Return files that cannot be refined, by what is wrong."""
    source = video(folder / "in.mp4", pictures(9))
    out = folder / "out.mp4"
    taken = video(folder / "taken.mp4", pictures(1))
    (folder / "folder.mp4").mkdir()
    (folder / "link.mp4").symlink_to(source)
    coloured = [np.stack([p[..., 0], 255 - p[..., 0], p[..., 0]], -1) for p in pictures(9)]
    late = video(folder / "late.mp4", pictures(9), times=[0, 1, 2, 3, 4, 5, 6, 7, 9])
    return {
        "shorter": RefineFiles(source, out, video(folder / "short.mp4", pictures(8))),
        "longer": RefineFiles(source, out, None, video(folder / "long.mp4", pictures(10))),
        "larger": RefineFiles(source, out, None, video(folder / "large.mp4", pictures(9, 80, 48))),
        "faster": RefineFiles(source, out, video(folder / "fast.mp4", pictures(9), Fraction(12))),
        "one frame late": RefineFiles(source, out, None, late),
        "coloured": RefineFiles(source, out, video(folder / "colour.mp4", coloured)),
        "no input": RefineFiles(folder / "none.mp4", out),
        "no opacity": RefineFiles(source, out, folder / "none.mp4"),
        "output exists": RefineFiles(source, taken),
        "comparison exists": RefineFiles(source, out, compare=taken),
        "over the input": RefineFiles(source, source, overwrite=True),
        "over its link": RefineFiles(source, folder / "link.mp4", overwrite=True),
        "over the map": RefineFiles(source, taken, None, taken, overwrite=True),
        "comparison is the output": RefineFiles(source, out, compare=out),
        "no folder": RefineFiles(source, folder / "a" / "out.mp4"),
        "a folder": RefineFiles(source, folder / "folder.mp4", overwrite=True),
        "no MP4": RefineFiles(source, folder / "out.avi"),
    }


def test_files_that_do_not_belong_together_are_refused_and_nothing_is_written(tmp_path):
    cases = misfits(tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    for case, files in cases.items():
        with pytest.raises(InputError):
            refine_video(files, Inverting)
        now = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
        assert now == before, case


def test_an_interrupted_video_leaves_nothing_and_the_same_call_completes_it(tmp_path):
    files = RefineFiles(
        video(tmp_path / "in.mp4", pictures(20)),
        tmp_path / "out.mp4",
        compare=tmp_path / "side.mp4",
    )

    def stop(frames, claimed):
        if frames > 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine_video(files, Inverting, stop)
    assert [path.name for path in tmp_path.iterdir()] == ["in.mp4"]
    assert refine_video(files, Inverting).frames == 20


def test_variable_frame_times_are_kept(tmp_path):
    times = [100, 140, 147, 1600, 1601, 1700]
    source = video(tmp_path / "in.mp4", pictures(6), times=times, base=Fraction(1, 1000))
    refine_video(RefineFiles(source, tmp_path / "out.mp4"), Inverting)
    assert read(tmp_path / "out.mp4")[0] == [Fraction(t, 1000) for t in times]
