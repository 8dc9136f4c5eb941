"""Read masks, and make them where there are none."""
