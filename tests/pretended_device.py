"""A CUDA device pretended on the CPU: tensors that say ``cuda:0``, compute on the CPU, refuse to be
mixed with tensors of the host, and count launches, copies and waits. What is captured as a graph
may neither wait nor copy from or to the host, and is computed again at every replay.

What cannot be pretended: speed, memory, rounding, and kernels that run at the same time.
"""

import inspect
from collections import Counter
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("cuda:0")
HOST = torch.device("cpu")
# Operations whose result the host must wait for, since it is a number or decides a size.
WAITS = {"_local_scalar_dense", "nonzero", "masked_select", "_unique2", "equal", "is_nonzero"}
# Operations that make no kernel run.
VIEWS = {
    "alias", "as_strided", "detach", "diagonal", "empty", "empty_strided", "expand", "permute",
    "select", "slice", "split", "split_with_sizes", "squeeze", "t", "transpose", "unbind",
    "unsqueeze", "view", "_unsafe_view", "_reshape_alias", "unfold", "lift_fresh", "new_empty",
    "empty_like",
}  # fmt: skip


# What Triton kernels write: grey everywhere, where they do not compute.
WRITTEN = {"records", "depths", "boxes", "counts", "tiles", "splats", "image", "levels", "pairs"}


@dataclass
class Traffic:
    """What a device did since `reset`."""

    launches: int = 0
    waits: Counter[str] = field(default_factory=Counter)
    bytes_up: int = 0
    bytes_pinned: int = 0  # of those up
    bytes_down: int = 0
    graph: object = None  # that is being captured
    backward: int = 0  # of a tensor of the device, in progress
    computes: bool = True  # whether its Triton kernels do

    def reset(self):
        """Forget everything."""
        self.launches = self.bytes_up = self.bytes_pinned = self.bytes_down = 0
        self.waits.clear()


traffic = Traffic()


class PretendedGraph:
    """The operations of a capture; a replay computes them again in the same memory."""

    def __init__(self):
        self.steps = []

    def replay(self):
        """Compute everything again."""
        traffic.launches += 1
        with torch.utils._python_dispatch._disable_current_modes():
            for func, args, kwargs, made in self.steps:
                again, _ = tree_flatten(func(*args, **kwargs))
                for place, value in zip(tree_flatten(made)[0], again, strict=True):
                    if isinstance(place, torch.Tensor):
                        place.copy_(value)


@contextmanager
def captured(graph, **options):
    """Record what runs on the device meanwhile."""
    traffic.graph = graph
    try:
        yield
    finally:
        traffic.graph = None


def _outside_of_a_capture(what):
    if traffic.graph is not None:
        raise RuntimeError(f"{what} in a part that is captured as a graph")


class OnDevice(torch.Tensor):
    """A tensor of the pretended device; ``held`` is the tensor of the host that it computes with."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held):
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=HOST,
        )
        made.held = held
        return made

    def __repr__(self, *, tensor_contents=None):
        return f"OnDevice({tuple(self.shape)}, {self.dtype})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


def _wrap(value):
    is_host = isinstance(value, torch.Tensor) and not isinstance(value, OnDevice)
    return OnDevice(value) if is_host else value


def _unwrap(value):
    if isinstance(value, OnDevice):
        return value.held
    return HOST if isinstance(value, torch.device) else value


def _run(func, args, kwargs):
    """Run an operation, on the device if a tensor of it takes part or it is asked for there."""
    name = func.overloadpacket.__name__
    flat, _ = tree_flatten((args, kwargs))
    ours = [x for x in flat if isinstance(x, OnDevice)]
    theirs = [x for x in flat if isinstance(x, torch.Tensor) and not isinstance(x, OnDevice)]
    asked = [x for x in flat if isinstance(x, torch.device)]
    wants_device = any(device.type == "cuda" for device in asked)
    wants_host = any(device.type == "cpu" for device in asked)
    result = func(*tree_map(_unwrap, args), **tree_map(_unwrap, kwargs))
    if name == "_to_copy" and ours and wants_host:
        # Autograd converts a gradient to the device that it takes a tensor to have.
        return _wrap(result) if traffic.backward else _downloaded(result)
    if name == "_to_copy" and theirs and wants_device:
        return _uploaded(result)
    if name == "copy_" and ours and theirs:
        target_is_ours = isinstance(args[0], OnDevice)
        _uploaded(theirs[0]) if target_is_ours else _downloaded(ours[0].held)
        return args[0]
    if not ours and not wants_device:
        # Autograd fills missing gradients with zeros, on the device that it takes a tensor to have.
        return _wrap(result) if name == "zeros" and traffic.backward else result
    mixed = [tensor for tensor in theirs if tensor.ndim > 0]
    if mixed:
        raise RuntimeError(
            f"{func}: a tensor of the host {tuple(mixed[0].shape)} beside the device"
        )
    if name in WAITS:
        _outside_of_a_capture(name)
        traffic.waits[name] += 1
        return tree_map(_wrap, result) if name != "_local_scalar_dense" else result
    if name not in VIEWS:
        traffic.launches += 1
        if traffic.graph is not None:
            given = tree_map(_unwrap, args), tree_map(_unwrap, kwargs)
            traffic.graph.steps.append((func, *given, result))
    written = func._schema.arguments[0].alias_info if func._schema.arguments else None
    if written is not None and written.is_write and result is ours[0].held:
        return args[0]
    return tree_map(_wrap, result)


def _downloaded(tensor):
    _outside_of_a_capture("a copy to the host")
    traffic.bytes_down += tensor.nbytes
    traffic.waits["copy to the host"] += 1
    return tensor


def _uploaded(tensor):
    _outside_of_a_capture("a copy from the host")
    traffic.bytes_up += tensor.nbytes
    return OnDevice(tensor.clone())


class _Dispatch(TorchDispatchMode):
    """Take operations that no tensor of the device takes part in: those that make one."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Answer what torch would ask a real device before it dispatches."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        first = args[0] if args else None
        asked = [*args[1:], *kwargs.values()]
        device = next((d for d in map(_device_of, asked) if d is not None), None)
        if name == "__get__" and isinstance(first, OnDevice):
            attribute = getattr(getattr(func, "__self__", None), "__name__", "")
            if attribute in ("device", "is_cuda", "is_cpu"):
                return {"device": DEVICE, "is_cuda": True, "is_cpu": False}[attribute]
        if name == "numpy" and isinstance(first, OnDevice):
            raise TypeError("a tensor of the device has no array: copy it to the host first")
        if name == "to" and isinstance(asked[0], torch.Tensor):
            device = DEVICE if isinstance(asked[0], OnDevice) else HOST
            args = first, asked[0].dtype
        if name in ("to", "cpu", "cuda") and isinstance(first, torch.Tensor):
            return _moved(first, HOST if name == "cpu" else device, func, args, kwargs)
        if name == "backward" and isinstance(first, OnDevice):
            traffic.backward += 1
            try:
                return func(*args, **kwargs)
            finally:
                traffic.backward -= 1
        if device is not None and device.type == "cuda" and name != "_parse_to":
            kwargs = {key: value for key, value in kwargs.items() if key != "device"}
            made = func(*args, **kwargs)
            if traffic.graph is not None:
                traffic.graph.steps.append((func, args, kwargs, made))
            return tree_map(_wrap, made)
        return func(*args, **kwargs)


def _moved(tensor, device, func, args, kwargs):
    """Move a tensor, then convert its type if that was asked for as well."""
    if device is None or (device.type == "cuda") == isinstance(tensor, OnDevice):
        rest = [value for value in args[1:] if isinstance(value, torch.dtype)]
        others = {key: value for key, value in kwargs.items() if key != "device"}
        return func(tensor, *rest, **others) if rest or others else tensor
    if device.type == "cuda":
        moved = _uploaded(tensor)
        traffic.bytes_pinned += tensor.nbytes * hasattr(tensor, "pinned")
        if kwargs.get("non_blocking") is not True:
            traffic.waits["copy to the device"] += 1
    else:
        moved = _downloaded(tensor.held.clone())
    types = [value for value in (*args[1:], *kwargs.values()) if isinstance(value, torch.dtype)]
    return moved.to(types[0]) if types else moved


def _device_of(value):
    if isinstance(value, torch.device):
        return value
    if isinstance(value, str) and value.partition(":")[0] in ("cpu", "cuda"):
        return torch.device(value)
    return None


def _pinned(tensor):
    copy = tensor.clone()
    copy.pinned = True
    return copy


class _Launches:
    """A Triton kernel that takes tensors of the device, and is interpreted on the host."""

    def __init__(self, kernel):
        self.kernel = kernel

    def __getitem__(self, grid):
        def launch(*args, **constants):
            if any(isinstance(x, torch.Tensor) and not isinstance(x, OnDevice) for x in args):
                raise RuntimeError("a kernel was given a tensor of the host")
            traffic.launches += 1
            with torch.utils._python_dispatch._disable_current_modes():
                if traffic.computes:
                    self.kernel[grid](*map(_unwrap, args), **constants)
                    return
                for name, value in zip(
                    inspect.signature(self.kernel.fn).parameters, args, strict=False
                ):
                    if name in WRITTEN:
                        value.held.fill_(0.5)

        return launch


class _Kernels:
    """The module of Triton kernels, for the pretended device."""

    def __init__(self, module):
        self.module = module

    def __getattr__(self, name):
        value = getattr(self.module, name)
        return _Launches(value) if hasattr(value, "__getitem__") else value


@contextmanager
def pretended_device(patch, computes=True):
    """Let torch have one CUDA device for a while.

    Args:
        patch: pytest's ``monkeypatch``.
        computes: Whether Triton kernels do; interpreted, they take seconds a frame.
    """
    pytest.importorskip("triton", reason="Triton is not installed")
    from alpasim_plugin.block_fixers.pipeline import BlockPipeline
    from alpasim_plugin.fixers import pixel_fixer
    from alpasim_plugin.fixers.semantic_map import tile_kernel
    from alpasim_plugin.gaussians.raster import rasterize_triton

    patch.setattr(torch.cuda, "is_available", lambda: True)
    patch.setattr(torch.cuda, "device_count", lambda: 1)
    patch.setattr(torch.cuda, "get_device_name", lambda: "pretended")
    # torch groups tensors by a device that a subclass cannot change, and would copy to it.
    patch.setattr(
        torch.nn.utils.clip_grad,
        "_group_tensors_by_device_and_dtype",
        lambda lists: {(lists[0][0].device, None): (lists, [])},
    )
    patch.setattr(torch.cuda, "CUDAGraph", PretendedGraph)
    patch.setattr(torch.cuda, "graph", captured)
    patch.setattr(
        torch.cuda, "Stream", lambda *place: SimpleNamespace(wait_stream=lambda other: None)
    )
    patch.setattr(torch.cuda, "current_stream", torch.cuda.Stream)
    patch.setattr(torch.cuda, "stream", nullcontext)
    patch.setattr(torch.Tensor, "pin_memory", _pinned)
    patch.setattr(torch.cuda, "device", nullcontext)
    modules = rasterize_triton.triton_kernels
    patch.setattr(rasterize_triton, "triton_kernels", lambda *name: _Kernels(modules(*name)))
    patch.setattr(tile_kernel, "draw_tiles", _Launches(tile_kernel.draw_tiles))
    # Subclasses of tensors do not work in inference mode; gradients are off in either.
    plain = torch.no_grad()(pixel_fixer.fix_frame.__wrapped__)  # type: ignore[attr-defined]
    patch.setattr(pixel_fixer, "fix_frame", plain)
    for name in ("run", "keep"):
        plain = torch.no_grad()(getattr(BlockPipeline, name).__wrapped__)
        patch.setattr(BlockPipeline, name, plain)
    overwrites = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    pixel_fixer._captured.cache_clear()  # a graph of a test before has another device's tensors
    traffic.reset()
    traffic.computes = computes
    try:
        with _Functions(), _Dispatch():
            yield traffic
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(overwrites)
