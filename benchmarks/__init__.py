"""Where every performance figure of the docs comes from; each module runs as `python -m benchmarks.NAME`."""
