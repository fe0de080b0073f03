"""The effects, one module each: when it is called for, what it costs, and how it is applied."""
