"""Where pairs of pictures come from."""
