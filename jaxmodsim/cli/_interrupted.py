"""Ctrl-C after which something was kept."""


class Interrupted(Exception):
    """Ctrl-C, after which what had been computed was written; the text says so."""
