"""Benches: a matrix of case x peer x quantity, and a few studies; `python -m bench --list` says what there is."""
