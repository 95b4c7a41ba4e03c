"""Where results go: tables and pictures."""
