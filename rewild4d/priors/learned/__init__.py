"""A learned prior: points of the body in 3D from masked pictures, trained on animals of the zoo's kind."""
