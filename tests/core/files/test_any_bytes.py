"""Damaged files of every kind: a reader refuses them with `SimrunError`, or returns something."""

import io
import json
from contextlib import suppress

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.files import read_json
from alpasim_plugin.core.files.arrays import open_npy, read_metadata
from alpasim_plugin.core.files.config import load_yaml
from alpasim_plugin.core.files.images import read_image
from alpasim_plugin.core.files.tables import read_parquet
from alpasim_plugin.gaussians import write_ply
from alpasim_plugin.gaussians.files import read_gaussians
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.writer import write_parquet
from scenarios.load import load_scenario
from tests.core.files.past_failures import png_header
from tests.gaussians.gaussian_scenes import random_cloud
from tests.gaussians.packed_writers import write_splat
from tests.log.make_rollout import write_rollout
from tests.scenarios.make_commonroad import write_commonroad
from tests.scenarios.make_usdz import write as write_usdz

SCENE = """version: 1
road: {segments: [{kind: straight, length_m: 120}, {kind: arc, length_m: 30, curvature_per_m: 0.01}]}
ego: {lane: 0, speed_mps: 8, cruise_mps: 9}
actors: [{kind: parked, id: a, s_m: 40, count: 2}, {kind: idm, id: b, s_m: 50, speed_mps: 9}]
"""


def npy():
    stream = io.BytesIO()
    np.save(stream, np.arange(12.0).reshape(3, 4))
    return stream.getvalue()


def by(write, name):
    def make(folder):
        write(folder / name)
        return (folder / name).read_bytes()

    return make


# name of a file -> its valid content, and its reader
READERS = {
    "a.yaml": (lambda folder: SCENE.encode(), load_yaml),
    "scene.yaml": (lambda folder: SCENE.encode(), load_scenario),
    "a.json": (lambda folder: json.dumps({"a": [1, 2.5, "x", None]}).encode(), read_json),
    "a.npy": (lambda folder: npy(), open_npy),
    "a.png": (lambda folder: png_header(7, 5), read_image),
    "a.parquet": (
        by(lambda p: pq.write_table(pa.table({"a": [1, 2]}), p), "v.parquet"),
        lambda path: read_parquet(path, {"a": "integer"}),
    ),
    "a.safetensors": (lambda folder: save({"a": np.zeros(3, dtype=np.float32)}), read_metadata),
    "a.ply": (by(lambda p: write_ply(p, random_cloud(6, degree=1)), "v.ply"), read_gaussians),
    "a.splat": (by(lambda p: write_splat(p, random_cloud(6, degree=0)), "v.splat"), read_gaussians),
    "rollout.asl": (by(write_rollout, "v.asl"), read_asl),
    "scene.xml": (by(write_commonroad, "v.xml"), load_scenario),
    "scene.usdz": (by(write_usdz, "v.usdz"), load_scenario),
}


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    return {name: make(tmp_path_factory.mktemp("valid")) for name, (make, _) in READERS.items()}


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(data=st.data())
def test_damaged_files_are_refused_or_read(name, valid, tmp_path, data):
    content = bytearray(valid[name])
    for _ in range(data.draw(st.integers(1, 4), label="damages")):
        at = data.draw(st.integers(0, len(content)), label="at")
        cut = data.draw(st.integers(0, 8), label="cut")
        content[at : at + cut] = data.draw(st.binary(max_size=8), label="instead")
    if data.draw(st.booleans(), label="truncated"):
        del content[data.draw(st.integers(0, len(content)), label="end") :]
    path = tmp_path / name
    path.write_bytes(content)
    with suppress(SimrunError):
        READERS[name][1](path)


def test_a_bit_that_turned_in_a_table_is_never_read_as_another_value(tmp_path):
    path = tmp_path / "rollouts.parquet"
    table = pa.table({"collision_any": [1.0, 0.0, 1.0, 0.0] * 8, "scene": ["a", "b"] * 16})
    write_parquet(path, table)
    data = path.read_bytes()
    refused = 0
    for place in range(4, len(data) - 8, 7):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        try:
            found = read_parquet(path, {"collision_any": "number"})
            assert found.column("collision_any").equals(table["collision_any"])
        except SimrunError:
            refused += 1
    assert refused > 5
