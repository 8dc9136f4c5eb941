"""What every CPU kernel stands on: compiling and caching, vectors of sixteen floats, threads."""
