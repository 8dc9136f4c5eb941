"""Who competes: one file a method."""
