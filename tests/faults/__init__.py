"""What goes wrong on real machines, row by row of the table in docs/reliability.md."""
