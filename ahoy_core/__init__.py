"""ahoy_core."""
