"""Cameras of inputs and novel views, and rendering from them."""
