"""The viewer in the browser: what the cameras see and what is measured."""
