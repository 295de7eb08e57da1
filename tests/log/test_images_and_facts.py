"""Camera images and the facts beside a log."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.log import decode_image, encode_image, read_facts, write_facts
from tests.examples import examples


@settings(max_examples=examples(40), deadline=None)
@given(hnp.arrays(np.uint8, st.tuples(st.integers(1, 20), st.integers(1, 20), st.just(3))))
def test_png_is_exact(rgb):
    assert_array_equal(decode_image(encode_image(rgb, "png")), rgb)


@pytest.mark.parametrize("encoding", ["png", "jpeg"])
def test_red_stays_red(encoding):
    red = np.zeros((16, 16, 3), dtype=np.uint8)
    red[..., 0] = 255
    back = decode_image(encode_image(red, encoding)).reshape(-1, 3).mean(axis=0)  # type: ignore[arg-type]
    assert_allclose(back, [255, 0, 0], atol=3)


def test_views_that_are_not_contiguous_are_encoded_as_seen():
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    assert_array_equal(decode_image(encode_image(image[::2, ::-1])), image[::2, ::-1])


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((4, 4, 3)),
        np.zeros((4, 4), dtype=np.uint8),
        np.zeros((4, 4, 4), dtype=np.uint8),
        np.zeros((0, 4, 3), dtype=np.uint8),
    ],
)
def test_other_arrays_are_refused(bad):
    with pytest.raises(InputError, match=r"not \(H, W, 3\) uint8"):
        encode_image(bad)


@pytest.mark.parametrize("data", [b"", b"no image", b"\x89PNG\r\n\x1a\n"])
def test_bytes_that_are_no_image_are_refused(data):
    with pytest.raises(InputError, match=f"{len(data)} bytes beginning"):
        decode_image(data)


def test_facts_come_back_as_given(tmp_path):
    rows = [
        {
            "t_us": 1_689_697_803_493_732,
            "camera": "front",
            "alpha_mean": 0.98,
            "events": "",
            "late": False,
            "none": None,
        },
        {},
    ]
    write_facts(tmp_path / "frames.jsonl", rows)
    assert read_facts(tmp_path / "frames.jsonl") == rows
    assert [p.name for p in tmp_path.iterdir()] == ["frames.jsonl"]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), object()])
def test_facts_that_json_cannot_hold_are_refused_and_leave_no_file(tmp_path, value):
    with pytest.raises(InputError):
        write_facts(tmp_path / "frames.jsonl", [{"a": value}])  # type: ignore[dict-item]
    assert list(tmp_path.iterdir()) == []


def test_broken_facts_name_their_line(tmp_path):
    (tmp_path / "f.jsonl").write_text('{"a": 1}\n{"a":\n')
    with pytest.raises(InputError, match="jsonl:2"):
        read_facts(tmp_path / "f.jsonl")
    (tmp_path / "f.jsonl").write_text("[1]\n")
    with pytest.raises(InputError, match="jsonl:1"):
        read_facts(tmp_path / "f.jsonl")
    with pytest.raises(InputError, match="no such file"):
        read_facts(tmp_path / "absent.jsonl")
    with pytest.raises(InfrastructureError):
        write_facts(tmp_path / "absent" / "f.jsonl", [])
