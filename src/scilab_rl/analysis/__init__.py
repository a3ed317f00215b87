"""Comparing runs: groups, statistics of few seeds, tables and reports."""
