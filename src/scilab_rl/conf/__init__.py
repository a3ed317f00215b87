"""The configuration that ships with the package."""
