"""Read annotated keypoints."""
