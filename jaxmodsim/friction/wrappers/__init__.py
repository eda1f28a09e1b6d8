"""Other ways to run a set-valued law."""
