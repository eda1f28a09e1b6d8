"""The search for the numbers that follow the records best: a point, not yet how sure it is."""
