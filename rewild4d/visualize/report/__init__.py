"""One page of a run that opens from disk: a player of its moving Gaussians beside the film, and what is known."""
