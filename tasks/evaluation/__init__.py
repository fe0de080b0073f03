"""Scoring avatars, and renders of other systems, against captures whose truth is known (paper section 4)."""
