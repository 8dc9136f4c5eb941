"""CPU kernels for the most expensive parts of a training step; each has a plain torch twin, which tests compare."""
