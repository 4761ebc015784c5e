"""Triggers: when a filter resets its own covariance."""
