"""Other ways to find the victim from the same demonstrations, to compare with."""
