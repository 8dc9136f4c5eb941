"""CPU kernels for the dear parts of a training step; each has a plain torch twin that the tests compare it with."""
