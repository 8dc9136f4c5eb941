"""Templates of animals: what the fit knows of a kind of body before it sees one."""
