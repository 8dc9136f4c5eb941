"""Draw pictures and films of a run."""
