"""Read weights: safetensors, or pickles that hold only tensors.

Tensors keep their stored precision by default; ``dtype`` converts the floating ones.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.limits import WEIGHT_BYTES
from alpasim_plugin.core.reading import check_regular, file_sha256, parsing
from alpasim_plugin.core.reading.files import open_regular

StateDict = dict[str, Tensor]
WRAPPERS = ("model", "state_dict")
RECOMPUTED = (
    "pos_embedder.seq",
    "pos_embedder.dim_spatial_range",
    "pos_embedder.dim_temporal_range",
)
CHECKPOINT_INFIX = "_checkpoint_wrapped_module."
LISTED = 8  # keys named in one error message; the rest is counted
ZIP_MAGIC, PICKLE_MAGIC = b"PK\x03\x04", b"\x80"


def load_weights(
    path: str | Path,
    dtype: torch.dtype | None = None,
    device: str = "cpu",
    sha256: str | None = None,
) -> StateDict:
    """Read a checkpoint file.

    Args:
        path: A ``.safetensors`` file, or a torch file that loads with ``weights_only`` (only
            tensors and plain containers).
        dtype: Precision for floating tensors; None keeps each as stored.
        device: Where the tensors go.
        sha256: Expected digest, in hexadecimal; checked before anything is read.

    Returns:
        Tensors by key, taken out of an outer ``{"model": ...}`` or ``{"state_dict": ...}``.

    Raises:
        InputError: No file, wrong digest, truncated or foreign file, or a pickle with other objects
            than tensors.
    """
    path = Path(path)
    check_regular(path, WEIGHT_BYTES)
    if sha256 is not None and (found := file_sha256(path)) != sha256.lower():
        raise InputError(
            f"{path}: sha256 {found}, not {sha256.lower()}",
            "download the file again or correct the expected digest",
        )
    with open_regular(path, WEIGHT_BYTES) as file:
        head = file.read(9)
    # A safetensors file begins with a length of 8 bytes and a JSON object; the length may look like
    # the start of a pickle.
    if not head.endswith(b"{") and head.startswith((ZIP_MAGIC, PICKLE_MAGIC)):
        content = _load_pickle(path, device)
    else:
        what = f"not a complete safetensors file of {path.stat().st_size} bytes"
        hint = "download or copy the file again; it is truncated or of another format"
        with parsing(path, hint, what):
            content = load_file(path, device=device)
    tensors = unwrap(content, str(path))
    if dtype is None:
        return tensors
    return {key: convert(key, value, dtype, str(path)) for key, value in tensors.items()}


def unwrap(content: object, source: str) -> StateDict:
    """Take the tensors out of an outer dictionary; entries of the training framework are dropped.

    Raises:
        InputError: No dictionary, no tensors, or something else under a key that should hold a
            tensor.
    """
    for wrapper in WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    tensors = dict(content) if isinstance(content, Mapping) else {}
    tensors = {str(key): value for key, value in tensors.items() if not _is_bookkeeping(str(key))}
    others = [key for key, value in tensors.items() if not isinstance(value, Tensor)]
    if others or not tensors:
        raise InputError(
            f"{source}: {', '.join(others[:LISTED]) or type(content).__name__} without tensors",
            "give a dictionary of tensors, alone or under the key 'model' or 'state_dict'",
        )
    return tensors


def clean(tensors: Mapping[str, Tensor]) -> StateDict:
    """Return the network's own tensors under their plain keys.

    A prefix ``net.`` is stripped; where it is used, everything without it (averaged weights,
    optimiser) is dropped. Also dropped: rotary buffers (recomputed), training counters,
    transformer-engine states, the infix of activation checkpointing.
    """
    prefixed = any(key.startswith("net.") for key in tensors)
    out: StateDict = {}
    for key, value in tensors.items():
        if prefixed and not key.startswith("net."):
            continue
        plain = key.removeprefix("net.").replace(CHECKPOINT_INFIX, "")
        if plain not in RECOMPUTED and not _is_bookkeeping(plain):
            out[plain] = value
    return out


def convert(key: str, value: Tensor, dtype: torch.dtype, source: str) -> Tensor:
    """Return a floating tensor in another precision, always as a copy; others unchanged.

    Raises:
        InputError: A finite value that overflows the new precision.
    """
    if not value.is_floating_point():
        return value
    out = value.detach().to(dtype, copy=True)
    if value.device.type != "meta" and bool((~out.isfinite() & value.isfinite()).any()):
        raise InputError(
            f"{source}: {key} holds {float(value.abs().max()):.4g}, beyond {dtype}",
            "use torch.bfloat16 or torch.float32",
        )
    return out


def weight(key: str, value: Tensor, dtype: torch.dtype, source: str) -> Tensor:
    """Return a copy of one weight in the precision a network wants, after validation.

    Raises:
        InputError: An integer tensor, or values that are not finite before or after the conversion.
    """
    if not value.is_floating_point():
        raise InputError(
            f"{source}: {key} holds {value.dtype}",
            "give floating-point weights; quantise after loading",
        )
    if value.device.type != "meta" and not bool(value.isfinite().all()):
        raise InputError(
            f"{source}: {key} holds {int((~value.isfinite()).sum())} values that are not finite, of {value.numel()}",
            "use a checkpoint from before training diverged",
        )
    return convert(key, value, dtype, source)


def load_checked(
    net: nn.Module,
    tensors: Mapping[str, Tensor],
    dtype: torch.dtype,
    source: str,
    hint: str = "give the weights of this network, all of them",
    float32: tuple[str, ...] = (),
) -> None:
    """Give a network copies of tensors in one precision; kernels become channels-last.

    Args:
        net: Its state dict gives the expected keys and shapes; it may be on the meta device.
        tensors: Half, single or double precision, also mixed.
        dtype: Precision of the parameters; buffers are float32.
        source, hint: For messages.
        float32: Parameters whose key contains one of these stay float32.

    Raises:
        InputError: Keys that are missing, unexpected or of another shape (all in one message), or
            values that are integers, not finite, or beyond ``dtype``.
    """
    expected = net.state_dict()
    wrong = []
    for key in sorted(expected.keys() & tensors.keys()):
        shape = list(tensors[key].shape)
        due = list(expected[key].shape)
        if shape != due:
            transposed = ", transposed" if sorted(shape) == sorted(due) else ""
            wrong.append(f"{key} is {shape} for {due}{transposed}")
    problems = [
        listed("missing", sorted(expected.keys() - tensors.keys())),
        listed("unexpected", sorted(tensors.keys() - expected.keys())),
        listed("wrong shape", wrong),
    ]
    if any(problems):
        counts = f"{len(tensors)} tensors, {len(expected)} expected"
        raise InputError(f"{source} ({counts}): {'; '.join(filter(None, problems))}", hint)
    buffers = {key for key, _ in net.named_buffers()}
    kept = {}
    for key in expected:
        is_float32 = key in buffers or any(part in key for part in float32)
        value = weight(key, tensors[key], torch.float32 if is_float32 else dtype, source)
        kept[key] = channels_last(value)
    net.load_state_dict(kept, assign=True)


def channels_last(kernel: Tensor) -> Tensor:
    """Return the kernel of a 2D or 3D convolution in channels-last memory; others unchanged."""
    if kernel.ndim == 4:
        return kernel.contiguous(memory_format=torch.channels_last)
    if kernel.ndim == 5:
        return kernel.contiguous(memory_format=torch.channels_last_3d)
    return kernel


def listed(what: str, keys: Sequence[str]) -> str:
    """Return keys for an error message, the first `LISTED` by name; empty without keys."""
    rest = f" and {len(keys) - LISTED} more" if len(keys) > LISTED else ""
    return f"{what}: {', '.join(keys[:LISTED])}{rest}" if keys else ""


def _is_bookkeeping(key: str) -> bool:
    return key.split(".")[-1].startswith("accum_") or key.endswith("_extra_state")


def _load_pickle(path: Path, device: str) -> object:
    try:
        # Pass an open file, since torch chooses its reader by the suffix. Byte buffers hold
        # transformer-engine states, which are dropped.
        with (
            open_regular(path, WEIGHT_BYTES) as file,
            torch.serialization.safe_globals([io.BytesIO]),
        ):
            return torch.load(file, map_location=device, weights_only=True)
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path}: a pickle that holds more than tensors; loading it could run code",
            "save the tensors alone, best as safetensors",
        ) from error
    except Exception as error:  # whatever the unpickler raises on damaged bytes
        raise InputError(
            f"{path}: a truncated or damaged torch file ({type(error).__name__})",
            "download or copy the file again",
        ) from error
