"""The rasterisers: reference, CPU, torch, Triton, and the CPU gradient."""
