"""Notebooks of the site: ``python -m docs.notebooks`` runs them and keeps their outputs."""
