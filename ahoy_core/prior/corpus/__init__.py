"""What the prior is trained on: rendered, clothed, haired people on the free body, from MakeHuman's CC0 garments."""
