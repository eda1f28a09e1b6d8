"""Public cases of others: each with its source, its published figures, an independent reference, and a derivative."""
