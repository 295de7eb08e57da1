"""Training pairs as one small file, for a machine with nothing else at hand: images and depths as
video, every other array as it is.

    SPLIT/SEQUENCE/CHANNEL.mp4    images; opacity and the logarithm of depth as grey levels
                   ARRAY.npy      poses, times, boxes
                   sequence.json  with the shapes of the videos, and by how much they differ

Video is lossy: a pack is for training, not for judging.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parse_json, parsing
from alpasim_plugin.core.files.arrays import open_npy
from alpasim_plugin.core.files.atomic import atomic_file, atomic_folder, restore_folder
from alpasim_plugin.core.files.limits import GIB, Bound
from alpasim_plugin.core.files.zips import open_zip, read_member
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.types import U8
from alpasim_plugin.lab.training.pair_store import SEQUENCE_FILE, write_info
from alpasim_plugin.lab.training.reference_store import F16
from alpasim_plugin.log.video import VideoReader, VideoWriter

IMAGES = ("rgb_input", "rgb_gt", "sdmap", "references/rgb")
SHARES = ("opacity",)
DEPTHS = ("depth", "references/depth")
PACKED = "packed"
LIMIT_BYTES = 40_000_000
SEQUENCE_BYTES = Bound(
    "unpacked size of a sequence", "bytes", 0, GIB, "200 frames of 1280 x 720 take 0.6 GB"
)
ENTRY_BYTES = 300  # of a file's entries in the archive, at most
CRF = 33  # of the encoder
# Depths from a quarter of a metre to a kilometre
NEAREST_M = 0.25
OCTAVES = 12.0
MAKE = "make it with 'simrun train pairs --pack'"


@dataclass(frozen=True)
class PackFacts:
    """What a pack holds.

    Attributes:
        sequences, frames: Packed.
        left_out: Sequences for which there was no room.
        bytes: Of the file.
        psnr_db: Mean over the sequences, of each kind of image against what was packed.
    """

    sequences: int
    frames: int
    left_out: int
    bytes: int
    psnr_db: Mapping[str, float]


def write_pack(folders: Sequence[Path], path: Path, limit_bytes: int = LIMIT_BYTES) -> PackFacts:
    """Pack finished sequences ``SPLIT/SEQUENCE`` in their order, as many as there is room for.

    Raises:
        InputError: No sequence, or no room for the first.
        InfrastructureError: The disk or the encoder refuses.
    """
    infos: list[dict[str, Any]] = []
    size = 0
    with atomic_file(path) as partial, zipfile.ZipFile(partial, "w") as archive:
        for folder in folders:
            files, info = _coded(folder)
            size += sum(len(zlib.compress(data)) + ENTRY_BYTES for data in files.values())
            if size > limit_bytes:
                break
            for name, data in files.items():
                entry = f"{folder.parent.name}/{folder.name}/{name}"
                archive.writestr(entry, data, zipfile.ZIP_DEFLATED)
            infos.append(info)
        if not infos:
            raise InputError(f"{path}: room for none of {len(folders)} sequences", MAKE)
    psnrs = [info[PACKED]["psnr_db"] for info in infos]
    means = {
        name: round(float(np.mean([row[name] for row in psnrs if name in row])), 2)
        for name in (*IMAGES, *SHARES)
        if any(name in row for row in psnrs)
    }
    frames = sum(info["frames"] for info in infos)
    left_out = len(folders) - len(infos)
    return PackFacts(len(infos), frames, left_out, path.stat().st_size, means)


def unpack(path: Path, folder: Path) -> Path:
    """Write the sequences of a pack below a folder; those that are there already are kept.

    Returns:
        The folder.

    Raises:
        InputError: It is no pack, or damaged.
    """
    with (
        parsing(path, MAKE, "no pack of training pairs"),
        open_zip(path, do_this=MAKE) as archive,
    ):
        names = archive.namelist()
        for name in names:
            split, sequence, *parts = name.split("/")
            if parts != [SEQUENCE_FILE]:
                continue
            restore_folder(folder / split / sequence)
            if not (folder / split / sequence / SEQUENCE_FILE).exists():
                start = f"{split}/{sequence}/"
                files = {name.removeprefix(start): name for name in names if name.startswith(start)}
                size = sum(archive.getinfo(entry).file_size for entry in files.values())
                SEQUENCE_BYTES.check(size, f"{path}, {start}")
                contents = {
                    name: read_member(archive, archive.getinfo(entry), SEQUENCE_BYTES, path, MAKE)
                    for name, entry in files.items()
                }
                _decode(contents, folder / split / sequence)
    return folder


def pairs_folder(pairs: Path, beside: Path) -> Path:
    """Return a folder of pairs; a pack is unpacked beside a folder."""
    return unpack(pairs, beside.parent / pairs.stem) if pairs.is_file() else pairs


def _coded(folder: Path) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Return the files of a sequence in a pack, and its facts."""
    info = dict(parse_json((folder / SEQUENCE_FILE).read_text(), folder))
    shapes: dict[str, list[int]] = {}
    psnr_of_file: dict[str, float] = {}
    files: dict[str, bytes] = {}
    for path in sorted(folder.rglob("*.npy")):
        name = path.relative_to(folder).with_suffix("").as_posix()
        if name not in (*IMAGES, *SHARES, *DEPTHS):
            files[f"{name}.npy"] = path.read_bytes()
            continue
        array = np.asarray(open_npy(path))
        levels = levels_of_depth(array) if name in DEPTHS else array
        coded = _encode(levels)
        files[f"{name}.mp4"] = coded
        shapes[name] = list(array.shape)
        if name not in DEPTHS:
            psnr_of_file[name] = psnr_db(_images(coded, array.shape), array)
    info[PACKED] = {"shapes": shapes, "psnr_db": psnr_of_file}
    files[SEQUENCE_FILE] = json.dumps(info).encode()
    return files, info


def _decode(files: Mapping[str, bytes], folder: Path) -> None:
    info = parse_json(files[SEQUENCE_FILE], folder)
    shapes = info[PACKED]["shapes"]
    with atomic_folder(folder) as partial:
        for name, data in files.items():
            channel, ending = os.path.splitext(name)
            if channel not in (*IMAGES, *SHARES, *DEPTHS) and ending == ".mp4":
                raise ValueError(f"the video {name}")
            target = partial / f"{channel}.npy"
            if ending == ".json":
                continue
            if target.resolve().parent not in (partial.resolve(), partial.resolve() / "references"):
                raise ValueError(f"the name {name}")
            target.parent.mkdir(exist_ok=True)
            if ending == ".npy":
                target.write_bytes(data)
                continue
            images = _images(data, shapes[channel])
            np.save(target, depth_of_levels(images) if channel in DEPTHS else images)
        write_info(partial, info)


def _encode(levels: U8) -> bytes:
    """Return images ``(T, H, W, 3)`` or grey levels ``(T, H, W)`` as a video."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "images.mp4"
        with VideoWriter(path, Fraction(1, 10), Fraction(10), crf=CRF, preset="slower") as video:
            for i, image in enumerate(levels):
                video.write(image if image.ndim == 3 else np.repeat(image[..., None], 3, 2), i)
        return path.read_bytes()


def _images(video: bytes, shape: Sequence[int]) -> U8:
    """Return the images of a video, of the shape that was packed.

    Raises:
        InputError: They would take more memory than the bound.
        ValueError: The video has others.
    """
    frames: list[U8] = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "images.mp4"
        path.write_bytes(video)
        with VideoReader(path) as reader:
            size = shape[0] * reader.format.width * reader.format.height * 3
            SEQUENCE_BYTES.check(size, f"images {tuple(shape)}")
            for frame in reader:
                if len(frames) == shape[0]:
                    raise ValueError(f"more than {shape[0]} images")
                frames.append(frame.image)
    images = np.stack(frames)[:, : shape[1], : shape[2]]
    images = images if len(shape) == 4 else images[..., 0]
    if images.shape != tuple(shape):
        raise ValueError(f"images {images.shape} for {tuple(shape)}")
    return np.ascontiguousarray(images)


def levels_of_depth(depth_m: F16) -> U8:
    """Return depths as grey levels: 0 where there is none, and 1 to 255 by their logarithm.

    Example:
        >>> levels_of_depth(np.array([0.0, 0.25, 16.0], np.float16)).tolist()
        [0, 1, 128]
    """
    depth = depth_m.astype(np.float32)
    octaves = np.log2(np.maximum(depth, NEAREST_M) / NEAREST_M)
    levels = 1 + np.rint(254 * np.minimum(octaves / OCTAVES, 1))
    return np.where(depth > 0, levels, 0).astype(np.uint8)


def depth_of_levels(levels: U8) -> F16:
    """Return the depths of grey levels; the inverse of `levels_of_depth` to its rounding."""
    depth = NEAREST_M * np.exp2((levels.astype(np.float32) - 1) * (OCTAVES / 254))
    return np.where(levels > 0, depth, 0).astype(np.float16)
