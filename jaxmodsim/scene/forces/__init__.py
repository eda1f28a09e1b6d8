"""Where forces act on the mechanism."""
