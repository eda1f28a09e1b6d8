"""What to measure next: inputs whose records tell most."""
