"""Measured records."""
