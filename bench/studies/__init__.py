"""Benches with a logic of their own; each has a `main(smoke)` that returns a `Result`."""
