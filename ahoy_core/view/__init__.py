"""What a viewer shows of an avatar: colours that explain, and where a Gaussian came from."""
