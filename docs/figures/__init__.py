"""The figures of the documentation: ``make docs-figures``."""
