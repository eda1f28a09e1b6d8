"""Which model: fitted models on records that they were not fitted to, and comparisons."""
