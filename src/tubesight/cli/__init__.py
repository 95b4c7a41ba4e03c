"""One file a command: it parses, calls an app and prints."""
