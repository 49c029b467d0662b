"""Camera frame in, multimodal feature vector out."""
