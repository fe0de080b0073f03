"""storage_schema."""
