"""Fused numba kernels of the template fit."""
