"""The real models behind the roles: what each needs, how it is loaded, and how it is called."""
