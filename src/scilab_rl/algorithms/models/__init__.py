"""Cognitive models: one file each, to act in choice tasks and to be fitted to choices."""
