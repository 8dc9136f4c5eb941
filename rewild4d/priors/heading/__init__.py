"""Which way an animal heads, read from masked pictures by a small network."""
