"""A batch in the queue: which videos are due, creating their runs, watching them, selecting what runs again."""
