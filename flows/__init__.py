"""Prefect flows and the `ahoy` command line: the wiring, and no science."""
