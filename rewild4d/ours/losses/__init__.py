"""Image losses and regularizers of `ours`."""
