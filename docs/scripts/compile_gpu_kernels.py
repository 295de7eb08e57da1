"""Compile the Triton kernels for a GPU that need not be here, and print what they use.

Usage: python docs/scripts/compile_gpu_kernels.py 80 90
"""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from alpasim_plugin.fixers.semantic_map.on_device import COLUMNS, tile_kernel
from alpasim_plugin.gaussians.constants import TILE
from alpasim_plugin.gaussians.raster import triton_kernels, triton_lens_kernels
from alpasim_plugin.gaussians.raster.lens_on_device import record_length
from alpasim_plugin.gaussians.raster.rasterize_triton import BLOCK, CHUNK

CONSTANTS = {
    "SIZE": 16,
    "TILE": TILE,
    "BLOCK": BLOCK,
    "CHUNK": CHUNK,
    "COLUMNS": COLUMNS,
    # A lens with all its terms and a rolling shutter takes most registers.
    "LENGTH": record_length(rolls=True),
    "ROLLS": True,
    "BENDS": True,
}
KERNELS = (
    triton_kernels.project,
    triton_kernels.list_tiles,
    triton_kernels.composite,
    triton_kernels.composite_backward,
    triton_lens_kernels.project_lens,
    triton_lens_kernels.composite_lens,
    tile_kernel.draw_tiles,
)
DOUBLES = ("poses", "camera", "means", "primitives", "samples", "cameras", "lenses", "motion")
TYPES = {
    "*u8": ("levels",),
    "*fp64": DOUBLES,
    "*i32": ("spans", "boxes", "counts", "tiles", "splats", "starts"),
    "*i64": ("order", "ends", "places"),
    "fp32": ("near_m",),
    "i32": ("tiles_x", "tiles_y", "total", "capacity", "width", "height", "rows", "most"),
    "constexpr": tuple(CONSTANTS),
}


def resources(kernel: Any, capability: int) -> str:
    """Return registers and bytes of stack (spilled registers) that a compiled kernel takes."""
    names = list(inspect.signature(kernel.fn).parameters)
    type_of = {name: kind for kind, names in TYPES.items() for name in names}
    source = ASTSource(
        fn=kernel,
        signature={name: type_of.get(name, "*fp32") for name in names},
        constexprs={name: CONSTANTS[name] for name in names if name in CONSTANTS},
    )
    compiled = triton.compile(source, target=GPUTarget("cuda", capability, 32))
    tool = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin", buffering=0) as file:
        file.write(compiled.asm["cubin"])
        command = [str(tool), "--dump-resource-usage", file.name]
        listing = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    (registers,), (stack,) = (re.findall(rf"{word}:(\d+)", listing) for word in ("REG", "STACK"))
    return f"registers {registers} stack {stack} "


if __name__ == "__main__":
    for wanted in map(int, sys.argv[1:]):
        for kernel in KERNELS:
            print(f"{kernel.fn.__name__} sm_{wanted} {resources(kernel, wanted)}")
