"""What a model makes of a record, and which of its numbers a fit may change."""
