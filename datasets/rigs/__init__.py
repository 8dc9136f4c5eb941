"""Read rigged, animated glTF files and render them with exact truth."""
