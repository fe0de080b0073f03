"""What `ahoy server` and `ahoy worker` start on one machine: Postgres, Prefect's server, and what is installed in it."""
