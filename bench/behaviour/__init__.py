"""The behaviour bench: what each friction law does in the standard experiments, and what it does not."""
