"""Read weights: safetensors, or pickles that hold only tensors."""

import io
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import check_regular, file_sha256, parsing
from alpasim_plugin.core.files.arrays import ONE_FILE, refuse_shards
from alpasim_plugin.core.files.limits import WEIGHT_BYTES
from alpasim_plugin.core.files.reading import open_regular

StateDict = dict[str, Tensor]
WRAPPERS = ("model", "state_dict")
RECOMPUTED = (
    "pos_embedder.seq",
    "pos_embedder.dim_spatial_range",
    "pos_embedder.dim_temporal_range",
)
INFIXES = ("_checkpoint_wrapped_module.", "_orig_mod.")  # of wrappers around layers
WRAPPER = "module."  # of data-parallel training, before all keys
# Where a training checkpoint holds both, the first is read
OWN = "net."
AVERAGED = "net_ema."
LISTED = 8  # keys named in one error message; the rest is counted
ZIP_MAGIC = b"PK\x03\x04"
PICKLE_MAGIC = b"\x80"


def load_weights(path: str | Path, sha256: str | None = None) -> StateDict:
    """Read a checkpoint file.

    Args:
        path: A ``.safetensors`` file, or a torch file that loads with ``weights_only`` (only
            tensors and plain containers).
        sha256: Expected digest, in hexadecimal; checked before anything is read.

    Returns:
        Tensors by key as stored, taken out of an outer ``{"model": ...}`` or ``{"state_dict": ...}``.

    Raises:
        InputError: No file, wrong digest, truncated or foreign file, or a pickle with other objects
            than tensors.
    """
    path = Path(path)
    refuse_shards(path)
    check_regular(path, WEIGHT_BYTES)
    if sha256 is not None and (actual_sha256 := file_sha256(path)) != sha256.lower():
        raise InputError(
            f"{path}: sha256 {actual_sha256}, not {sha256.lower()}",
            "download the file again or correct the expected digest",
        )
    with open_regular(path, WEIGHT_BYTES) as file:
        head = file.read(9)
    # A safetensors file begins with a length of 8 bytes and a JSON object; the length may look like
    # the start of a pickle.
    if not head.endswith(b"{") and head.startswith((ZIP_MAGIC, PICKLE_MAGIC)):
        content = _load_pickle(path)
    else:
        failure = f"not a complete safetensors file of {path.stat().st_size} bytes"
        hint = "download or copy the file again; it is truncated or of another format"
        with parsing(path, hint, failure):
            content = load_file(path)
    return unwrap(content, str(path))


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

    A prefix ``module.`` is stripped, then ``net.``, or else ``net_ema.``; where one is used,
    everything without it (other weights, optimiser) is dropped. Also dropped: rotary buffers
    (recomputed), training counters, transformer-engine states, the infixes of wrappers.
    """
    keys = {key.removeprefix(WRAPPER): value for key, value in tensors.items()}
    used = [prefix for prefix in (OWN, AVERAGED) if any(key.startswith(prefix) for key in keys)]
    prefix = used[0] if used else ""
    out = {}
    for key, value in keys.items():
        plain = key.removeprefix(prefix)
        for infix in INFIXES:
            plain = plain.replace(infix, "")
        is_own = key.startswith(prefix) and plain not in RECOMPUTED
        if is_own and not _is_bookkeeping(plain):
            out[plain] = value
    return out


def weight(key: str, value: Tensor, source: str) -> Tensor:
    """Return a float32 copy of one weight.

    Raises:
        InputError: An integer tensor, or values that are not finite in float32.
    """
    if not value.is_floating_point():
        raise InputError(
            f"{source}: {key} holds {value.dtype}",
            "give floating-point weights; quantise after loading",
        )
    out = value.detach().to(torch.float32, copy=True)
    finite = out.isfinite()
    if not out.is_meta and not bool(finite.all()):
        raise InputError(
            f"{source}: {key} holds {int((~finite).sum())} values that are not finite, of {out.numel()}",
            "use a checkpoint from before training diverged",
        )
    return out


def load_checked(
    net: nn.Module,
    tensors: Mapping[str, Tensor],
    source: str,
    hint: str = "give the weights of this network, all of them",
) -> None:
    """Give a network copies of tensors in float32; kernels become channels-last.

    Args:
        net: Its state dict gives the expected keys and shapes; it may be on the meta device.
        tensors: Half, single or double precision, also mixed.
        source, hint: For messages.

    Raises:
        InputError: Keys that are missing, unexpected or of another shape (all in one message), or
            values that are integers, or not finite in float32.
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
    kept = {key: channels_last(weight(key, tensors[key], source)) for key in expected}
    net.load_state_dict(kept, assign=True)


def channels_last(kernel: Tensor) -> Tensor:
    """Return the kernel of a 2D or 3D convolution in channels-last memory; others unchanged."""
    if kernel.ndim == 4:
        return kernel.contiguous(memory_format=torch.channels_last)
    if kernel.ndim == 5:
        return kernel.contiguous(memory_format=torch.channels_last_3d)
    return kernel


def listed(heading: str, keys: Sequence[str]) -> str:
    """Return keys for an error message, the first `LISTED` by name; empty without keys."""
    more = f" and {len(keys) - LISTED} more" if len(keys) > LISTED else ""
    return f"{heading}: {', '.join(keys[:LISTED])}{more}" if keys else ""


def _is_bookkeeping(key: str) -> bool:
    return key.split(".")[-1].startswith("accum_") or key.endswith("_extra_state")


def _load_pickle(path: Path) -> object:
    try:
        # Pass an open file, since torch chooses its reader by the suffix. Byte buffers hold
        # transformer-engine states, which are dropped.
        with (
            open_regular(path, WEIGHT_BYTES) as file,
            torch.serialization.safe_globals([io.BytesIO]),
        ):
            return torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path}: a pickle that holds more than tensors; loading it could run code",
            ONE_FILE,
        ) from error
    except Exception as error:  # whatever the unpickler raises on damaged bytes
        raise InputError(
            f"{path}: a truncated or damaged torch file ({type(error).__name__})",
            "download or copy the file again",
        ) from error
