"""The files of a reconstruction in the cache: the model, its sky views, and the hash of each."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.scene.log_views import SkyView
from alpasim_plugin.io.atomic import write_json
from alpasim_plugin.io.checksums import sha256_of
from alpasim_plugin.io.reading import read_json_as

HASHES, SKY_VIEWS = "hashes.json", "sky_views.npz"
DOING, DO_THIS = "reading a reconstruction", "remove its folder; it is made again when it is needed"


def write_model(folder: Path, model: Reconstruction, sky_views: Sequence[SkyView], facts: Mapping[str, Any]) -> None:
    """Write a reconstruction and its sky views into an existing, empty folder.

    Raises:
        InfrastructureError, OSError: The disk refuses.
    """
    model.save(folder, facts)
    bits = [np.packbits(view.sky > 0.5) for view in sky_views]
    np.savez_compressed(
        folder / SKY_VIEWS,
        size=np.array([[v.camera.width, v.camera.height] for v in sky_views], dtype=np.int64).reshape(-1, 2),
        K=np.array([v.camera.K for v in sky_views]).reshape(-1, 3, 3),
        T_camera_world=np.array([v.camera.T_camera_world for v in sky_views]).reshape(-1, 4, 4),
        sky=np.concatenate(bits) if bits else np.zeros(0, np.uint8),
    )
    write_json(folder / HASHES, {name: sha256_of(folder / name) for name in _files(folder)})


def read_model(folder: Path) -> tuple[Reconstruction, list[SkyView]]:
    """Read what `write_model` wrote: exactly the files that it lists, each with the hash it was written with.

    Raises:
        InputError: A file is missing or is another one than was written.
    """
    hashes = read_json_as(dict[str, str], folder / HASHES, DOING, do_this=DO_THIS)
    there = set(_files(folder)) - {HASHES}
    odd = sorted(there ^ set(hashes))
    if odd or not hashes:  # a list that names other files than are there checks nothing
        found = f"{odd[0]} is {'not listed' if odd[0] in there else 'missing'}" if odd else "it lists no file"
        raise _damaged(folder / HASHES, found)
    for name, expected in hashes.items():
        try:
            content = sha256_of(folder / name)
        except OSError as error:
            raise _damaged(folder / name, error.strerror or str(error)) from error
        if content != expected:
            raise _damaged(folder / name, "not the content that was written")
    return Reconstruction.load(folder), _read_sky_views(folder / SKY_VIEWS)


def _read_sky_views(path: Path) -> list[SkyView]:
    try:
        with np.load(path, allow_pickle=False) as file:
            sizes, Ks, Ts, bits = file["size"], file["K"], file["T_camera_world"], file["sky"]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise _damaged(path, str(error)) from error
    views, first = [], 0
    for (width, height), K, T in zip(sizes.tolist(), Ks, Ts, strict=True):
        length = -(-width * height // 8)
        sky = np.unpackbits(bits[first : first + length], count=width * height).reshape(height, width)
        views.append(SkyView(PinholeCamera(width, height, K, T), sky.astype(np.float32)))
        first += length
    return views


def _files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def _damaged(path: Path, found: str) -> InputError:
    return InputError(DOING, str(path), found, DO_THIS)
