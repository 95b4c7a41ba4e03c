"""Boards, lenses and relative poses, the base frame, and a report on how good they are."""
