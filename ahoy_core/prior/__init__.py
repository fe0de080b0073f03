"""The generative prior (paper, section 3.2): a small rectified-flow video model of clothed people."""
