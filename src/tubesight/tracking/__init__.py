"""What is carried from frame to frame: pairing, watching over cameras, states, prediction, the rig's health."""
