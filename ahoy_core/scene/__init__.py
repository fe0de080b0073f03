"""Scenes, what each one calls for, and avatars rendered in them (paper section 3.4)."""
