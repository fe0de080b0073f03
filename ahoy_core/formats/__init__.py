"""Files in and out: video, images, Gaussians (`.ply`) and arrays (`.npz`)."""
