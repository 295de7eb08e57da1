"""Networks of metrics that are given as ONNX files, run by onnxruntime (extra ``onnx``)."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.types import F32

INPUTS = ("image", "K")


def load_onnx(path: Path) -> Callable[[F32, F32], tuple[Any, ...]]:
    """Load an ONNX network with the inputs ``image`` and ``K``, for inference on the CPU.

    Raises:
        InfrastructureError: onnxruntime is not installed.
        InputError: A file that it cannot read, or other inputs.
    """
    try:
        onnxruntime = import_module("onnxruntime")
    except ImportError as error:
        raise InfrastructureError(
            f"{path}: onnxruntime is not installed", "Install it: pip install onnxruntime"
        ) from error
    try:
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    except Exception as error:  # its exceptions have no common class of their own
        raise InputError(
            f"{path}: no ONNX network that onnxruntime {onnxruntime.__version__} can read: {error}",
            "Give a file that torch.onnx.export wrote.",
        ) from error
    names = [node.name for node in session.get_inputs()]
    if sorted(names) != sorted(INPUTS):
        raise InputError(f"{path}: inputs {', '.join(names)}", f"Name them {' and '.join(INPUTS)}.")

    def call(image: F32, K: F32) -> tuple[Any, ...]:
        return tuple(session.run(None, {"image": image, "K": K}))

    return call
