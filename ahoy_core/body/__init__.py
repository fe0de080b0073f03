"""The body: model protocol, packaged free body, rotations, skinning, canonical pose, landmarks, poses across bodies."""
