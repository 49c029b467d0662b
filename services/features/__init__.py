"""Feature extraction: camera frames in, multimodal feature vectors out."""
