"""``tubesight live`` and what belongs to it: measuring while cameras run, recording, and replay."""
