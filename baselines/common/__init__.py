"""Share what Gaussian competitors have in common: the training loop, its settings, the scene's frame of reference."""
