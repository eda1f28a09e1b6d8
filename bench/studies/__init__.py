"""Benches outside the matrix; each has a function `main(smoke, out)` that returns a `Result`."""
