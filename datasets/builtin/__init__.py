"""Make the built-in procedural animals."""
