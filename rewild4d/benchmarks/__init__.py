"""Benchmarks of the `bench` command: scenes, timing, peers and tables."""
