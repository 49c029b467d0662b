"""What each part of the filter is for, and whether its probabilities hold."""
