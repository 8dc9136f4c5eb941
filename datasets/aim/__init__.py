"""Animal-in-Motion: crops of animals out of films."""
