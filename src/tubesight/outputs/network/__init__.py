"""Results over the network: OpenIGTLink, JSON over WebSocket and UDP; on this machine alone unless asked otherwise."""
