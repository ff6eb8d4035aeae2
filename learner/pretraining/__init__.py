"""Pre-training of the image encoder: frames on disk, objectives, training, linear probes."""
