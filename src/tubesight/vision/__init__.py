"""Pixels to the view of one camera: edges, centreline and tip, as pixels and rays."""
