"""Laws that depend on direction, or on the state of the mechanism."""
