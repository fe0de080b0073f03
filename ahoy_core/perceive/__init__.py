"""Where the person is: landmarks, a body fitted to them over time, and masks (paper section 3.1, first half)."""
