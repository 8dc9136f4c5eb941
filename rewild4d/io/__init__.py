"""Read and write PLY, OBJ and GLB files, and sample their surfaces."""
