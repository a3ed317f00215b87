"""One run: its parts, its directory, and its course from the configuration to the result."""
