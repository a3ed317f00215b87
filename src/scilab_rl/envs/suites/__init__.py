"""Variants of tasks from other packages; each file is imported when its package is used."""
