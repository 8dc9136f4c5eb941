"""Where a reconstruction starts from: the procedural quadruped and its fit to a masked clip."""
