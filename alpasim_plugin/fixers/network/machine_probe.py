"""What this machine computes quickly, asked of the machine: a convolution as the generators have
them, timed in a few milliseconds.

Instruction sets alone do not tell: bfloat16 is several times as fast as float32 where the processor
multiplies matrices of it, about as fast where it only converts, and several times slower where it
is emulated; and a second thread that shares a core may cost more than it brings. Within a run each
node is asked once, for all of its workers (`alpasim_plugin.core.cache`).

Where a fixer computes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from alpasim_plugin.core.cache import measured
from alpasim_plugin.core.errors import FixerError

REPEATS = 5
LONG_ENOUGH_S = 0.1  # no further turn after this: what takes so long has lost
CHANNELS = 48
HEIGHT = 36
WIDTH = 64
# so much faster bfloat16 must be to be taken: a probe on a busy machine may be off by some tenths
WORTH = 1.5
WORTH_A_THREAD = 1.1


@dataclass(frozen=True)
class Probe:
    """One convolution at two precisions.

    Attributes:
        fp32_ms, bf16_ms: Least processor time of several runs that took turns; that of all threads.
            Other load on the machine, which wall time would show, must not decide: another
            precision is another picture.
        fp32_error, bf16_error: Distance of the result from float64, relative in the Euclidean norm.
    """

    fp32_ms: float
    bf16_ms: float
    fp32_error: float
    bf16_error: float


@dataclass(frozen=True)
class Threads:
    """How many threads torch uses, and why."""

    number: int
    why: str
    ms: Mapping[int, float]  # of the probe, by number of threads; empty where there was no choice

    def as_dict(self) -> dict[str, Any]:
        """Return it for a record."""
        return {
            "number": self.number,
            "why": self.why,
            "ms": {str(n): round(ms, 3) for n, ms in self.ms.items()},
        }


def probe_precision() -> Probe:
    """Time the convolution in float32 and bfloat16 with torch's present number of threads, unless
    the run has done so on this node.
    """
    return Probe(**measured("precision", lambda: asdict(_time_precisions())))


def _time_precisions() -> Probe:
    exact = _convolve(*_operands(torch.float64))
    operands = {dtype: _operands(dtype) for dtype in (torch.float32, torch.bfloat16)}
    ms = dict.fromkeys(operands, float("inf"))
    error = {}
    for dtype, pair in operands.items():
        error[dtype] = float(
            (_convolve(*pair).double() - exact).norm() / exact.norm()
        )  # the first run, which also sets up kernels
    began = time.perf_counter()
    for turn in range(REPEATS):
        if turn and time.perf_counter() - began > LONG_ENOUGH_S:
            break
        for dtype, pair in operands.items():
            ms[dtype] = min(ms[dtype], _ms(*pair, clock=time.process_time))
    return Probe(ms[torch.float32], ms[torch.bfloat16], error[torch.float32], error[torch.bfloat16])


def choose_threads(most: int) -> Threads:
    """Return the number of torch threads that pays, at most ``most``, as it was found on this node
    by the run's first process.

    One thread is taken unless all of them together are faster by a tenth. Torch's own setting is as
    before afterwards.

    Example:
        >>> choose_threads(1)
        Threads(number=1, why='one is all there is', ms={})
    """
    if most == 1:
        return Threads(1, "one is all there is", {})
    found = measured(f"threads-{most}", lambda: _time_threads(most).as_dict())
    return Threads(found["number"], found["why"], {int(n): ms for n, ms in found["ms"].items()})


def _time_threads(most: int) -> Threads:
    pair, before = _operands(torch.float32), torch.get_num_threads()
    ms = {1: float("inf"), most: float("inf")}
    began = time.perf_counter()
    try:
        for turn in range(REPEATS + 1):
            if turn > 1 and time.perf_counter() - began > LONG_ENOUGH_S:
                break
            for number in ms:
                torch.set_num_threads(number)
                took = _ms(*pair)
                ms[number] = (
                    min(ms[number], took) if turn else ms[number]
                )  # the first turn sets up kernels and threads
    finally:
        torch.set_num_threads(before)
    gain = ms[1] / ms[most]
    return Threads(
        most if gain > WORTH_A_THREAD else 1,
        f"{most} threads are {gain:.2g} times as fast as one",
        ms,
    )


def _operands(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    seeded = torch.Generator().manual_seed(0)
    image = torch.randn(1, CHANNELS, HEIGHT, WIDTH, generator=seeded, dtype=torch.float64)
    kernel = (
        torch.randn(CHANNELS, CHANNELS, 3, 3, generator=seeded, dtype=torch.float64)
        / (9 * CHANNELS) ** 0.5
    )
    return image.to(dtype).contiguous(memory_format=torch.channels_last), kernel.to(
        dtype
    ).contiguous(memory_format=torch.channels_last)


@torch.inference_mode()
def _convolve(image: Tensor, kernel: Tensor) -> Tensor:
    return torch.nn.functional.conv2d(image, kernel, padding=1)


def _ms(image: Tensor, kernel: Tensor, clock: Callable[[], float] = time.perf_counter) -> float:
    began = clock()
    _convolve(image, kernel)
    return (clock() - began) * 1e3


@dataclass(frozen=True)
class Choice:
    """A precision, and the reason for it."""

    name: Literal["fp32", "bf16"]
    why: str
    probe: Probe | None = None  # what was measured; None where nothing had to be

    def as_dict(self) -> dict[str, Any]:
        """Return it for a record, with the measured error of one convolution at this precision."""
        out: dict[str, Any] = {"name": self.name, "why": self.why}
        if self.probe is not None:
            out |= {
                "error": self.probe.bf16_error if self.name == "bf16" else self.probe.fp32_error,
                "probe": asdict(self.probe),
            }
        return out


def choose_precision(
    wanted: Literal["auto", "fp32", "bf16"] = "auto", device: str = "cpu"
) -> Choice:
    """Return the precision of convolutions that pays on this machine.

    ``auto`` is bfloat16 on a GPU, and on a processor on which a convolution in bfloat16 takes at
    most two thirds of the time that it takes in float32
    (`alpasim_plugin.fixers.network.machine_probe`). Where bfloat16 is emulated it takes several
    times as long.

    Example:
        >>> choose_precision("fp32")
        Choice(name='fp32', why='as set', probe=None)
    """
    if wanted != "auto":
        return Choice(wanted, "as set")
    if device.split(":")[0] == "cuda":
        return Choice("bf16", "a GPU")
    probe = probe_precision()
    gain = probe.fp32_ms / probe.bf16_ms
    return Choice(
        "bf16" if gain >= WORTH else "fp32",
        f"bfloat16 is {gain:.2g} times as fast as float32 on this processor",
        probe,
    )


def require_device(device: str) -> None:
    """Refuse a CUDA device on a machine without one.

    Raises:
        FixerError: torch sees no such device.
    """
    if device.split(":")[0] == "cuda" and not torch.cuda.is_available():
        raise FixerError(f"device {device!r}: torch sees no CUDA device", "use --device cpu")


def take_threads(threads: int | None) -> dict[str, Any]:
    """Set torch's threads to as many of the allowed ones as pay.

    Args:
        threads: That this process may use; None leaves their number.

    Returns:
        The choice with its measurements, under ``threads``, for a fixer's ``chosen``; empty where
        nothing was chosen.
    """
    if threads is None:
        return {}
    number = choose_threads(threads)
    torch.set_num_threads(number.number)
    return {"threads": number.as_dict()}
