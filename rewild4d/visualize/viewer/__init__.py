"""A page in the browser on which saved reconstructions are seen from any side, at any time."""
