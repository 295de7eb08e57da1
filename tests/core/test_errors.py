"""Which failures of a part must come again."""

import concurrent.futures
import json
import pickle
import subprocess

import pytest

from alpasim_plugin.core.errors import PolicyError, RendererFault


class OutOfMemoryError(RuntimeError):
    """As torch raises it on a full card."""


OUTSIDE = [
    FileNotFoundError("weights.pt"),
    MemoryError(),
    ImportError("no module"),
    OutOfMemoryError("CUDA out of memory"),
    RuntimeError("CUDA error"),
    TimeoutError(),
    concurrent.futures.TimeoutError(),
    subprocess.TimeoutExpired("sleep", 1),
    ConnectionResetError(),
    KeyError("gain"),
    json.JSONDecodeError("expected", "x", 0),
    ValueError("no weights"),
    pickle.UnpicklingError(),
]
OF_CODE = [
    AttributeError("route"),
    TypeError(),
    NameError("x"),
    ZeroDivisionError(),
    AssertionError(),
]


@pytest.mark.parametrize("cause", OUTSIDE, ids=lambda cause: type(cause).__name__)
def test_what_may_come_from_the_world_outside_is_not_final(cause):
    error = PolicyError("it raised", "correct it")
    error.__cause__ = cause
    assert not error.is_final


@pytest.mark.parametrize("kind", [PolicyError, RendererFault])
@pytest.mark.parametrize("cause", [*OF_CODE, None], ids=lambda cause: type(cause).__name__)
def test_what_only_wrong_code_raises_or_returns_is_final(kind, cause):
    error = kind("it raised", "correct it")
    error.__cause__ = cause
    assert error.is_final
