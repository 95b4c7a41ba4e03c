"""What a rig will be able to measure, before it is built: predicted deviations and the best places of cameras."""
