"""On what: readers, writers and splits."""
