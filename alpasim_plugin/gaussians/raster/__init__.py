"""The rasterisers: reference, CPU, torch, gsplat, and the CPU gradient."""
