"""The behaviour bench: all friction laws in the standard experiments."""
