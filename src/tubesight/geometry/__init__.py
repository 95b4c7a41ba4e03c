"""Pure mathematics on arrays; no images, no files."""
