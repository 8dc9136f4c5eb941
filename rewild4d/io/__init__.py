"""Read and write PLY, OBJ and GLB files, and sample their surfaces."""

KINDS = ("ply", "glb", "cameras", "mp4")
"""Files that `export` writes of a reconstruction."""
