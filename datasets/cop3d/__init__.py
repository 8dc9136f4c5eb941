"""CoP3D: films of pets with cameras."""
