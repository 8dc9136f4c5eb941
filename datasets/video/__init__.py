"""Read videos of unknown cameras: DAVIS, APTv2, and a user's own."""
