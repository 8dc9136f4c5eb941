"""Score reconstructions and folders of results by a protocol."""
