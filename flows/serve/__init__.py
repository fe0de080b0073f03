"""What `ahoy server` and `ahoy worker` start: Postgres, Prefect's server, what is installed in it, and workers."""
