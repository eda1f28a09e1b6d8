"""The benches. Each is a script that runs alone; `python -m bench` runs them all."""
