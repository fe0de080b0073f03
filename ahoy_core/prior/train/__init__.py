"""How the prior is trained: resumable loops with averaged weights; checkpoints are safetensors, nothing is pickled."""
